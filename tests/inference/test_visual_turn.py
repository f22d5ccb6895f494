"""Test that a robot which turns in place sees by its colours how it has turned, and does not imagine that it sees."""

import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.tracking import visual_turn
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition import GaussianBelief, planar_belief

CAMERA = Camera.from_hfov(160, 120, 0.5 * np.pi)
ROBOT = HolonomicRobot()
RIG = Rig.of(CAMERA, ROBOT.T_body_cam)
COMMANDED, NOISE = 0.2, 0.105  # rad: a full turn at noise "mid"
PLACES = [(2.0, 1.0), (4.0, 3.0), (6.3, 5.0), (3.2, 5.1), (1.2, 4.2)]  # m, in reed


@pytest.fixture(scope="module")
def camera():
    found = RaycastCamera(load_scene("reed").boxes(), CAMERA)
    yield found
    found.close()


def grey(camera: RaycastCamera, planar: np.ndarray, gain: float = 1.0) -> jnp.ndarray:
    """Return the small luminance of the view from a pose, without any depth."""
    rgb, depth = camera.render(planar_to_matrix(planar) @ ROBOT.T_body_cam)
    rgb = np.clip(gain * rgb.astype(float), 0.0, 255.0).astype(np.uint8)
    return visual_turn.small_grey(RGBD.from_camera(rgb, np.zeros_like(depth)), CAMERA)


def beliefs(planar: np.ndarray, driven: float = 0.0) -> tuple[GaussianBelief, GaussianBelief]:
    """Return the beliefs before and, as predicted, after a commanded turn."""
    ahead = driven * np.array([np.cos(planar[2]), np.sin(planar[2]), 0.0])
    before = planar_belief(jnp.asarray(planar, jnp.float32), 1e-4 * jnp.eye(3))
    after = jnp.asarray(planar + ahead + np.array([0.0, 0.0, COMMANDED]), jnp.float32)
    return before, planar_belief(after, jnp.diag(jnp.array([1e-4, 1e-4, 1e-4 + NOISE**2])))


def test_the_turn_is_seen_to_half_a_degree_whatever_the_exposure(camera):
    rng, errors, told = np.random.default_rng(0), [], []
    for place in PLACES:
        for _ in range(6):
            planar = np.array([*place, rng.uniform(-np.pi, np.pi)])
            turned = float(np.clip(rng.normal(COMMANDED, NOISE), 0.0, 0.6))
            before, predicted = beliefs(planar)
            images = grey(camera, planar), grey(camera, planar + np.array([0, 0, turned]), gain=rng.uniform(0.85, 1.1))
            belief, sees = visual_turn.turned(predicted, before, *images, RIG)
            told.append(bool(sees))
            if sees:
                errors.append(float(belief.mean[2]) - planar[2] - turned)
                # The turn's noise is gone but for the images' own; the heading before is as uncertain as it was.
                assert float(belief.covariance[2, 2]) == pytest.approx(1e-4 + visual_turn.STD**2, rel=0.02)
                np.testing.assert_allclose(belief.mean[:2], planar[:2], atol=1e-5)
            else:
                np.testing.assert_allclose(belief.mean, predicted.mean, atol=1e-6)
                np.testing.assert_allclose(belief.covariance, predicted.covariance, atol=1e-9)
    assert np.mean(told) > 0.8
    wrapped = (np.array(errors) + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(wrapped).max() < 4.0 * visual_turn.STD


def test_a_correction_is_the_products_of_two_gaussians(camera):
    """The mean moves by q / (q + s^2) of what the images show."""
    planar = np.array([*PLACES[0], 0.7])
    before, predicted = beliefs(planar)
    images = grey(camera, planar), grey(camera, planar + np.array([0, 0, COMMANDED + 0.1]))
    belief, sees = visual_turn.turned(predicted, before, *images, RIG)
    assert sees
    share = NOISE**2 / (NOISE**2 + visual_turn.STD**2)
    assert float(belief.mean[2]) - planar[2] - COMMANDED == pytest.approx(0.1 * share, abs=0.008)


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_images_without_contrast_tell_nothing(level):
    before, predicted = beliefs(np.zeros(3))
    flat = jnp.full((60, 80), level)
    assert not visual_turn.turned(predicted, before, flat, flat, RIG)[1]


def test_images_of_two_places_tell_nothing(camera):
    """A robot that was carried off has not turned."""
    told = []
    for a, b in zip(PLACES, PLACES[1:] + PLACES[:1], strict=True):
        planar = np.array([*a, 0.3])
        before, predicted = beliefs(planar)
        images = grey(camera, planar), grey(camera, np.array([*b, 2.0]))
        told.append(bool(visual_turn.turned(predicted, before, *images, RIG)[1]))
    assert not any(told)


def test_a_robot_that_drove_is_not_corrected(camera):
    planar = np.array([*PLACES[0], 0.7])
    before, predicted = beliefs(planar, driven=0.1)
    images = grey(camera, planar), grey(camera, planar + np.array([0, 0, COMMANDED]))
    assert not visual_turn.turned(predicted, before, *images, RIG)[1]
