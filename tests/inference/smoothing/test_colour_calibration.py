"""Test that the smoother finds the calibration of a colour camera, and says where the images do not tell it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.slam_recordings import CAMERA
from tests.inference.smoothing.colour_room import COLOUR, DT, FRAMES, STATED, TRUE, images, true_pose
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import PRIOR_STD, ColourCamera, displacements
from vssm_gym.geometry.transforms import inverse, se3_exp
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.prism.config import HAND
from vssm_gym.inference.smoothing import agreement
from vssm_gym.inference.smoothing.exposure import gains
from vssm_gym.inference.smoothing.gauss_newton import ColourPrior, Smoothed, SmoothingConfig, smooth
from vssm_gym.inference.smoothing.views import draw_elements, stack_apart
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.model.transition import RIGID
from vssm_gym.model.transition.manifold import RigidState

ALIGN = AlignConfig()
STD = ALIGN.geo_sigma, ALIGN.geo_sigma_quadratic
PRIOR = ColourPrior(STATED, PRIOR_STD)
POINTS = np.array([[0.3, -0.2, 1.5], [-0.8, 0.4, 2.5], [0.1, 0.5, 0.7]])  # m, colour camera's frame


def smoothed(frames: list[int], seed: int = 0, off: float = 0.003) -> Smoothed:
    """Smooth the images of some frames; the poses start ``off`` (m, rad) the true ones, the calibration as stated."""
    T = np.stack([true_pose(k) for k in frames])
    xi = np.random.default_rng(seed).normal(0.0, off, (len(T), 6))
    xi[0] = 0.0
    start = jnp.asarray(inverse(T[0]) @ T, jnp.float32) @ se3_exp(jnp.asarray(xi, jnp.float32))
    states = RigidState(start, jnp.zeros((len(T), 6)))
    views = stack_apart([images(k) for k in frames], CAMERA, STATED, STD)
    belief = at_rest(RIGID, start[0], 1e-8 * jnp.eye(6), (1.0, 1.0))
    steps = len(T) - 1
    given = jnp.zeros((steps, 6)), jnp.full(steps, DT)
    config = SmoothingConfig(align=ALIGN, elements=3000)
    key = jax.random.key(seed)
    return smooth(key, views, Rig.of(CAMERA), HAND, belief, states, *given, config, colour_prior=PRIOR)


@pytest.fixture(scope="module")
def found() -> Smoothed:
    return smoothed(list(range(FRAMES)))


def test_a_displacement_moves_the_image_as_the_calibration_does() -> None:
    """Against central differences of the projection in float64, parameter by parameter."""
    camera = TRUE.camera
    x, y, z = POINTS.T
    o = np.zeros_like(x)
    by_point = np.array([[camera.fx / z, o, -camera.fx * x / z**2], [o, camera.fy / z, -camera.fy * y / z**2]])
    analytic = np.einsum("ijn,njk->nik", by_point, np.asarray(displacements(jnp.asarray(POINTS)), float))
    p_depth = POINTS @ np.asarray(TRUE.T_depth_colour)[:3, :3].T + np.asarray(TRUE.T_depth_colour)[:3, 3]

    def pixels(theta: np.ndarray) -> np.ndarray:
        moved = TRUE.moved(theta)
        q = (p_depth - moved.T_depth_colour[:3, 3]) @ moved.T_depth_colour[:3, :3]
        return (q @ moved.camera.K.T)[:, :2] / q[:, 2:]

    step = 1e-3
    for k, e in enumerate(np.eye(10)):
        numeric = (pixels(step * e) - pixels(-step * e)) / (2.0 * step)
        np.testing.assert_allclose(analytic[:, :, k], numeric, rtol=2e-3, atol=0.02)


def test_the_luminance_changes_with_the_calibration_as_its_slope_says() -> None:
    """On an image that is a plane in the pixels, where bilinear reading is exact."""
    v, u = np.mgrid[0 : COLOUR.height, 0 : COLOUR.width]
    grey, points = jnp.asarray(0.004 * u + 0.003 * v, jnp.float32), jnp.asarray(POINTS[:2], jnp.float32)
    _, slope, inside = agreement._luminance(grey, points, STATED.camera)
    analytic = np.einsum("ni,nik->nk", np.asarray(slope), np.asarray(displacements(points)))
    assert inside.all()
    step = 0.005
    for k, e in enumerate(np.eye(10)):
        values = []
        for sign in (1.0, -1.0):
            moved = STATED.moved(sign * step * e)
            q = jnp.asarray(POINTS[:2] - moved.T_depth_colour[:3, 3], jnp.float32) @ moved.T_depth_colour[:3, :3]
            values.append(np.asarray(agreement._luminance(grey, q, moved.camera)[0]))
        np.testing.assert_allclose(analytic[:, k], (values[0] - values[1]) / (2.0 * step), rtol=0.01, atol=1e-3)


def test_the_elements_are_integrated_out_of_the_border() -> None:
    """Against the joint system of poses, calibration and elements in float64, with weights that are constant."""
    rng, times, elements = np.random.default_rng(0), 4, 7
    value = rng.normal(size=(times, elements))
    by_pose, by_theta = rng.normal(size=(times, elements, 6)), rng.normal(size=(times, elements, 10))
    std, seen = 0.1 + rng.uniform(size=(times, elements)), (rng.uniform(size=(times, elements)) < 0.7).astype(float)
    seen[:2] = 1.0
    n = 6 * times
    J = np.zeros((times, elements, n + 10 + elements))
    for t in range(times):
        J[t, :, 6 * t : 6 * t + 6], J[t, :, n : n + 10] = by_pose[t], by_theta[t]
        J[t, np.arange(elements), n + 10 + np.arange(elements)] = -1.0
    W = seen / std**2
    H = np.einsum("tvi,tv,tvj->ij", J, W, J)
    a, b = slice(0, n + 10), slice(n + 10, None)
    expected = H[a, a] - H[a, b] @ np.linalg.solve(H[b, b], H[b, a])
    off = value - (W * value).sum(axis=0) / W.sum(axis=0)
    as32 = lambda x: jnp.asarray(x, jnp.float32)
    region = jnp.zeros(elements, jnp.int32)
    border = agreement._border(as32(value), as32(by_pose), as32(by_theta), as32(std), as32(seen), 1e6, region)
    np.testing.assert_allclose(border.hessian, expected[n:, n:], rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(np.asarray(border.with_poses).reshape(n, 10), expected[:n, n:], rtol=1e-3, atol=1e-2)
    gradient = np.einsum("tvk,tv,tv->k", by_theta, W, off)
    np.testing.assert_allclose(border.gradient, gradient, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(border.by_region[0], gradient, rtol=1e-3, atol=1e-2)


@pytest.mark.slow
def test_the_calibration_is_found_with_the_poses(found: Smoothed) -> None:
    assert found.colour is not None
    before, after = STATED.difference(TRUE), found.colour.difference(TRUE)
    assert np.linalg.norm(before[:3]) > 0.02
    assert np.linalg.norm(after[:3]) < 0.003
    assert np.linalg.norm(after[3:6]) < np.radians(0.3)
    assert np.abs(after[6:8]).max() < 0.005


def test_its_errors_are_within_what_it_states(found: Smoothed) -> None:
    assert found.colour is not None and found.colour_covariance is not None
    off = found.colour.difference(TRUE)
    assert off @ np.linalg.solve(found.colour_covariance, off) / 10.0 < 4.0
    std = np.sqrt(np.diag(found.colour_covariance))
    assert std[:3].max() < 0.01
    assert std[6:8].max() < 0.01


def test_the_poses_are_found_too(found: Smoothed) -> None:
    T = np.stack([true_pose(k) for k in range(FRAMES)])
    off = np.asarray(found.states.T_world_body)[:, :3, 3] - (inverse(T[0]) @ T)[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.006
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_a_camera_that_stands_still_leaves_the_prior() -> None:
    """All images show an element at one pixel: any calibration explains them equally well."""
    found = smoothed([0] * 8, off=0.0)
    assert found.colour is not None and found.colour_covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(found.colour_covariance)), PRIOR_STD, rtol=0.1)
    assert (np.abs(STATED.difference(found.colour)) < 0.1 * PRIOR_STD).all()


def test_few_views_tell_less(found: Smoothed) -> None:
    few = smoothed(list(range(4)))
    assert few.colour_covariance is not None and found.colour_covariance is not None
    assert (np.diag(few.colour_covariance) > np.diag(found.colour_covariance)).all()
    assert (np.sqrt(np.diag(few.colour_covariance)) < 1.2 * PRIOR_STD).all()


def test_exposures_are_found_up_to_their_mean() -> None:
    rng = np.random.default_rng(0)
    surface, log_gain = rng.uniform(0.2, 0.9, 400), rng.normal(0.0, 0.1, 12)
    seen = (rng.uniform(size=(12, 400)) < 0.4).astype(np.float32)
    shown = surface * np.exp(-log_gain)[:, None] + rng.normal(0.0, 0.01, (12, 400))
    shown[:, :20] = rng.uniform(size=(12, 20))  # edges
    found = np.log(np.asarray(gains(jnp.asarray(shown, jnp.float32), jnp.asarray(seen))))
    np.testing.assert_allclose(found - found.mean(), log_gain - log_gain.mean(), atol=0.01)


def test_registered_images_have_no_calibration_to_learn() -> None:
    views = replace(stack_apart([images(0), images(1)], CAMERA, STATED, STD), colour=None)
    states = RigidState(jnp.tile(jnp.eye(4), (2, 1, 1)), jnp.zeros((2, 6)))
    belief = at_rest(RIGID, jnp.eye(4), 1e-8 * jnp.eye(6), (1.0, 1.0))
    given = jnp.zeros((1, 6)), jnp.full(1, DT)
    with pytest.raises(InputError, match="a colour camera apart"):
        smooth(jax.random.key(0), views, Rig.of(CAMERA), HAND, belief, states, *given, colour_prior=PRIOR)


def test_a_colour_camera_in_the_place_of_the_depth_camera_changes_no_equation() -> None:
    """Registered images, and the same ones with a colour camera at the identity and equal exposures."""
    camera = Camera(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    rng = np.random.default_rng(0)
    shown = [(rng.integers(90, 160, (60, 80, 3), dtype=np.uint8), images(k)[1]) for k in range(4)]
    apart = stack_apart(shown, CAMERA, ColourCamera(camera, jnp.eye(4)), STD)
    T = jnp.asarray(np.stack([true_pose(k) for k in range(4)]), jnp.float32)
    elements = draw_elements(jax.random.key(0), apart, T, 500)
    one = agreement.normal_equations(replace(apart, colour=None), T, elements, ALIGN, 0.05)
    two = agreement.normal_equations(apart, T, elements, ALIGN, 0.05)
    assert one.border is None and two.border is not None
    assert float(one.pairs) == float(two.pairs)
    np.testing.assert_allclose(one.hessian, two.hessian, rtol=0.05, atol=0.05 * float(jnp.abs(one.hessian).max()))
