"""Test the comparison of all images at elements of surfaces: the map integrated out, and what no image can know."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.prism_room import CAMERA, ROOM, image, true_pose
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.smoothing import agreement
from vssm_gym.inference.smoothing.agreement import normal_equations
from vssm_gym.inference.smoothing.views import draw_elements, stack_views
from vssm_gym.model.emission import RGBD

CONFIG = AlignConfig()
STD = CONFIG.geo_sigma, CONFIG.geo_sigma_quadratic
FRAMES = range(0, 12, 2)
GATE = jnp.float32(0.1)


@pytest.fixture(scope="module")
def views():
    return stack_views([image(k) for k in FRAMES], CAMERA, STD)


@pytest.fixture(scope="module")
def poses():
    return jnp.asarray(np.stack([true_pose(k) for k in FRAMES]), jnp.float32)


@pytest.fixture(scope="module")
def found(views, poses):
    elements = draw_elements(jax.random.key(0), views, poses, 2000)
    return normal_equations(views, poses, elements, CONFIG, GATE)


def test_elements_lie_on_the_surfaces_that_the_images_show(views, poses):
    elements = draw_elements(jax.random.key(1), views, poses, 500)
    assert np.percentile(np.abs(ROOM.occupancy(np.asarray(elements.point, float))), 95) < 0.003
    np.testing.assert_allclose(np.linalg.norm(elements.normal, axis=1), 1.0, atol=1e-4)


def test_images_at_their_true_poses_agree(found):
    assert float(found.cost) < 0.5
    assert float(found.pairs) > 4000


def test_a_motion_of_all_cameras_together_changes_nothing(found, poses):
    """The map moves with them: the Hessian has six directions without curvature, and no slope along them."""
    world = np.asarray(se3_adjoint(inverse(poses)), float).reshape(-1, 6)  # each camera's twist for one of the world
    H = np.asarray(found.hessian, float).reshape(len(world), len(world))
    together = world.T @ H @ world
    alone = world[6:].T @ H[6:, 6:] @ world[6:]  # the first camera stays
    assert np.abs(together).max() < 2e-3 * np.diag(alone).min()


def test_the_hessian_is_positive(found, poses):
    H = np.asarray(found.hessian, float).reshape(6 * len(poses), -1)
    np.testing.assert_allclose(H, H.T, atol=1e-4 * np.abs(H).max())
    assert np.linalg.eigvalsh(H).min() > -1e-4 * np.abs(H).max()


def test_its_parts_by_region_add_up_to_the_gradient(found):
    np.testing.assert_allclose(found.by_region.sum(axis=0), found.gradient, rtol=1e-3, atol=0.05)


def test_the_elements_are_integrated_out_as_in_a_dense_system():
    """Against the joint system of poses and elements in float64, with weights that are constant."""
    rng = np.random.default_rng(0)
    times, elements = 4, 7
    value, by_pose = rng.normal(size=(times, elements)), rng.normal(size=(times, elements, 6))
    std, seen = 0.1 + rng.uniform(size=(times, elements)), (rng.uniform(size=(times, elements)) < 0.7).astype(float)
    seen[:2] = 1.0
    J = np.zeros((times, elements, 6 * times + elements))
    for t in range(times):
        J[t, :, 6 * t : 6 * t + 6] = by_pose[t]
        J[t, np.arange(elements), 6 * times + np.arange(elements)] = -1.0
    W = seen / std**2
    H = np.einsum("tvi,tv,tvj->ij", J, W, J)
    a, b = slice(0, 6 * times), slice(6 * times, None)
    m = (W * value).sum(axis=0) / W.sum(axis=0)
    g = np.einsum("tvi,tv,tv->i", J, W, value - m)
    expected = H[a, a] - H[a, b] @ np.linalg.solve(H[b, b], H[b, a])
    as32 = lambda x: jnp.asarray(x, jnp.float32)
    hessian, parts, _ = agreement._integrated(as32(value), as32(by_pose), as32(std), as32(seen), 1e6)
    np.testing.assert_allclose(np.asarray(hessian).reshape(6 * times, -1), expected, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(np.asarray(parts).sum(axis=1).reshape(-1), g[a], rtol=1e-3, atol=1e-2)


def test_the_gradient_is_that_of_the_cost(views, poses):
    """A small motion of one camera, by finite differences of the quadratic cost about the moved means."""
    elements = draw_elements(jax.random.key(2), views, poses, 4000)
    config = AlignConfig(huber=1e3)
    off = poses.at[2].set(poses[2] @ se3_exp(jnp.asarray([0.01, -0.005, 0.004, 0.003, 0.004, -0.003])))
    before = normal_equations(views, off, elements, config, GATE)
    step = -np.linalg.solve(np.asarray(before.hessian[2, :, 2], float), np.asarray(before.gradient[2], float))
    after = normal_equations(
        views, off.at[2].set(off[2] @ se3_exp(jnp.asarray(step, jnp.float32))), elements, config, GATE
    )
    assert np.linalg.norm(after.gradient[2]) < 0.15 * np.linalg.norm(before.gradient[2])
    assert float(after.cost) < float(before.cost)


def test_an_image_without_depth_says_nothing(poses):
    dark = RGBD.from_camera(np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), np.float32))
    views = stack_views([image(0), dark, image(2)], CAMERA, STD)
    elements = draw_elements(jax.random.key(0), views, poses[:3], 500)
    found = normal_equations(views, poses[:3], elements, CONFIG, GATE)
    assert not np.any(found.hessian[1]) and not np.any(found.gradient[1])
    assert np.any(found.hessian[0])
