"""Test the smoother: it finds a trajectory that was disturbed, states its errors, and respects what it is given."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.prism_room import CAMERA, DT, image, true_pose
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_exp, se3_log
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.prism.config import HAND
from vssm_gym.inference.smoothing.gauss_newton import Smoothed, SmoothingConfig, mean_states, smooth
from vssm_gym.inference.smoothing.views import stack_views
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition import RIGID
from vssm_gym.model.transition.manifold import RigidState

ALIGN = AlignConfig()
CONFIG = SmoothingConfig(elements=2000)
FRAMES = 16
DARK = RGBD.from_camera(np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), np.float32))


def true_states() -> RigidState:
    poses = jnp.asarray(np.stack([true_pose(k) for k in range(FRAMES)]), jnp.float32)
    moved = jnp.einsum("tij,tjk->tik", poses[1:, :3, :3], jnp.swapaxes(poses[:-1, :3, :3], 1, 2))
    turned = se3_log(jnp.zeros((FRAMES - 1, 4, 4)).at[:, 3, 3].set(1.0).at[:, :3, :3].set(moved))[:, 3:]
    velocity = jnp.concatenate([poses[1:, :3, 3] - poses[:-1, :3, 3], turned], axis=1) / DT
    return RigidState(poses, jnp.concatenate([velocity[:1], velocity]))


def smoothed(states: RigidState, images=None, seed: int = 0, config: SmoothingConfig = CONFIG) -> Smoothed:
    images = [image(k) for k in range(FRAMES)] if images is None else images
    views = stack_views(images, CAMERA, (ALIGN.geo_sigma, ALIGN.geo_sigma_quadratic))
    start = at_rest(RIGID, states.T_world_body[0], 1e-8 * jnp.eye(6), (1.0, 1.0))
    steps = FRAMES - 1
    given = jnp.zeros((steps, 6)), jnp.full(steps, DT)
    return smooth(jax.random.key(seed), views, Rig.of(CAMERA), HAND, start, states, *given, config)


def errors(found: RigidState) -> np.ndarray:
    """Return the errors of the poses, ``(time, 6)``."""
    return np.asarray(se3_log(inverse(found.T_world_body) @ true_states().T_world_body), float)


def disturbed(seed: int = 0, size: float = 0.02) -> RigidState:
    """Return the true states with errors of a random walk in their poses."""
    xi = np.cumsum(np.random.default_rng(seed).normal(0.0, size / 4.0, (FRAMES, 6)), axis=0)
    xi[0] = 0.0
    true = true_states()
    return RigidState(true.T_world_body @ se3_exp(jnp.asarray(xi, jnp.float32)), true.velocity)


@pytest.fixture(scope="module")
def found():
    return smoothed(disturbed())


@pytest.mark.slow
def test_a_disturbed_trajectory_is_found(found):
    before, after = (np.abs(errors(states)).max(axis=0) for states in (disturbed(), found.states))
    assert before.max() > 0.02
    assert after[:3].max() < 0.003
    assert after[3:].max() < 0.003
    assert found.costs[-1] < 0.7 * found.costs[0]


def test_its_errors_are_within_what_it_states(found):
    xi = errors(found.states)[1:]
    covariance = found.covariance[1:, :6, :6]
    nees = np.einsum("ti,tij,tj->t", xi, np.linalg.inv(covariance), xi) / 6.0
    assert np.median(nees) < 3.0
    assert np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 6.0).max() < 0.005


def test_errors_of_a_surface_widen_the_covariance():
    """A wall that each image shows at another distance: the same number of readings, stated as less certain."""
    rng, exact = np.random.default_rng(0), [image(k) for k in range(FRAMES)]
    far = [jnp.where(one.depth > 2.0, one.depth * (1.0 + 0.03 * rng.normal()), one.depth) for one in exact]
    moved = [eqx.tree_at(lambda one: one.depth, one, depth) for one, depth in zip(exact, far, strict=True)]
    std = [np.sqrt(np.trace(smoothed(true_states(), images).covariance[8, :3, :3])) for images in (exact, moved)]
    assert std[1] > 1.5 * std[0]


def test_the_first_pose_stays_and_covariances_are_positive(found):
    assert np.abs(errors(found.states)[0]).max() < 1e-4
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_velocities_follow_from_the_poses(found):
    off = np.asarray(found.states.velocity[2:-1] - true_states().velocity[2:-1])
    assert np.abs(off).max() < 0.15


def test_images_without_depth_leave_the_transition_alone():
    """Between frames that are seen, those that are not lie about where a constant velocity leads."""
    images = [DARK if 6 <= k <= 8 else image(k) for k in range(FRAMES)]
    found = smoothed(disturbed(1), images)
    assert np.abs(errors(found.states))[:, :3].max() < 0.02
    std = np.sqrt(np.trace(found.covariance[:, :3, :3], axis1=1, axis2=2))
    assert std[7] > 2.0 * std[3]


def test_the_same_key_gives_the_same_states():
    a, b, other = (smoothed(disturbed(), seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a.states.T_world_body, b.states.T_world_body)
    assert not np.array_equal(a.states.T_world_body, other.states.T_world_body)


def test_the_mean_of_iterations_hardly_depends_on_what_was_drawn():
    """With few elements: two draws differ less in the mean of six iterations than in one."""
    apart = {}
    for count in (1, 6):
        config = SmoothingConfig(elements=200, averaged=count)
        runs = [smoothed(disturbed(), seed=seed, config=config) for seed in (0, 1)]
        apart[count] = np.linalg.norm(errors(runs[0].states) - errors(runs[1].states))
    assert apart[6] < 0.7 * apart[1]


def test_the_mean_of_states_on_both_sides_is_between_them():
    xi = 0.1 * jax.random.normal(jax.random.key(0), (FRAMES, 12))
    states = [RIGID.perturb(true_states(), side * xi) for side in (1.0, -1.0, 0.0)]
    off = RIGID.error(true_states(), mean_states(RIGID, states))
    np.testing.assert_allclose(off, 0.0, atol=1e-5)


def test_bad_input_is_named():
    with pytest.raises(InputError, match="views"):
        smoothed(disturbed(), [image(0)] * 3)
    with pytest.raises(InputError, match="surface"):
        smoothed(disturbed(), [DARK] * FRAMES)
