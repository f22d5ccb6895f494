"""Test the smoothing of a window: earlier images hold it in place, and an image that shows nothing says nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.prism_room import CAMERA, DT, image, true_pose
from tests.inference.smoothing.test_gauss_newton import true_states
from vssm_gym.geometry.transforms import se3_exp, se3_log
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.prism.config import HAND
from vssm_gym.inference.smoothing.gauss_newton import SmoothingConfig
from vssm_gym.inference.smoothing.window import SmoothedWindow, Step, smooth_window, view_of, without_image
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.model.transition import RIGID
from vssm_gym.model.transition.manifold import RigidState

ALIGN = AlignConfig()
CONFIG = SmoothingConfig(elements=2000, gates=(0.1, 0.1, 0.05))
FIRST, FREE, HELD = 6, 4, 3
SHIFT = np.array([0.02, -0.015, 0.01, 0.004, -0.004, 0.006])  # m, rad: of all poses of the window, in the world


def state(k: int, shift: np.ndarray) -> RigidState:
    true = jax.tree.map(lambda leaf: leaf[k], true_states())
    moved = se3_exp(jnp.asarray(shift, jnp.float32)) @ true.T_world_body
    return RigidState(moved, true.velocity)


def smoothed(shift: np.ndarray, earlier: list[int], blank: int | None = None, std: float = 0.05) -> SmoothedWindow:
    """Smooth four images whose poses are all off alike, against earlier images at their true poses."""
    views = [without_image(CAMERA) if k == blank else view_of(image(FIRST + k), CAMERA, ALIGN) for k in range(FREE)]
    steps = [Step(state(FIRST + k, shift), view, jnp.zeros(6), DT) for k, view in enumerate(views)]
    start = at_rest(RIGID, steps[0].state.T_world_body, std**2 * jnp.eye(6), (1.0, 1.0))
    known = [(view_of(image(k), CAMERA, ALIGN), true_pose(k)) for k in earlier]
    rng = np.random.default_rng(0)
    return smooth_window(rng, steps, FREE, known, HELD, Rig.of(CAMERA), HAND, start, CONFIG)


def off(found: SmoothedWindow) -> np.ndarray:
    """Return the largest errors of a pose, m and rad."""
    T = [np.linalg.inv(true_pose(FIRST + k)) @ np.asarray(s.T_world_body, float) for k, s in enumerate(found.states)]
    xi = np.abs(np.asarray(se3_log(jnp.asarray(np.stack(T), jnp.float32))))
    return np.array([xi[:, :3].max(), xi[:, 3:].max()])


def test_earlier_images_hold_the_window_in_place():
    assert (off(smoothed(SHIFT, [0, 2, 4])) < 0.003).all()
    assert off(smoothed(SHIFT, []))[0] > 0.01  # no image tells where the window is


def test_what_nothing_tells_is_as_uncertain_as_the_start():
    std = lambda found: np.sqrt(np.trace(found.covariance[0, :3, :3]) / 3.0)
    assert std(smoothed(np.zeros(6), [])) == pytest.approx(0.05, rel=0.2)
    assert std(smoothed(np.zeros(6), [0, 2, 4])) < 0.005


def test_a_step_without_an_image_lies_between_its_neighbours():
    found = smoothed(np.zeros(6), [0, 2, 4], blank=2)
    assert off(found)[0] < 0.01
    std = [np.sqrt(np.trace(covariance[:3, :3])) for covariance in found.covariance]
    assert std[2] > 2.0 * std[1]


def test_images_state_what_they_share():
    assert min(smoothed(np.zeros(6), [0, 2, 4]).held_shares) > 0.3
    assert smoothed(np.zeros(6), [0, 2, 4]).shared > 0.5
    assert smoothed(np.zeros(6), [0, 2, 4], blank=FREE - 1).shared == 0.0
