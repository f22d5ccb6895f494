"""Test the published Adam solver: Gauss-Newton's optimum, the paper's loss and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.localisation_room import CAMERA, ROOM
from vssm_gym.geometry.transforms import inverse, se3_exp, se3_log
from vssm_gym.inference.alignment import adam
from vssm_gym.inference.alignment.adam import AdamConfig, align_adam, minimise
from vssm_gym.inference.alignment.gauss_newton import align
from vssm_gym.inference.alignment.residuals import AlignConfig, make_observed, make_reference

CONFIG, ADAM = AlignConfig(), AdamConfig()
T_REF = camera_pose((-0.4, 0.1, 0.6), 0.2, 0.1)
MOTION = np.array([0.03, -0.02, 0.025, 0.02, -0.03, 0.015])
REFERENCE = ROOM.image(T_REF, CAMERA)
OBSERVED = ROOM.image(T_REF @ np.asarray(se3_exp(jnp.asarray(MOTION, jnp.float32)), float), CAMERA)
solve = jax.jit(align_adam, static_argnums=(7, 9))
FREE, WEAK = jnp.eye(6), jnp.diag(jnp.array([0.05] * 3 + [0.03] * 3) ** -2.0)


def run(key: int = 0, precision=WEAK, basis=FREE, prior=None, observed=OBSERVED, config=ADAM):
    prior = jnp.eye(4) if prior is None else prior
    return solve(prior, precision, prior, basis, REFERENCE, observed, CAMERA, CONFIG, jax.random.key(key), config)


def test_it_finds_the_motion_and_agrees_with_gauss_newton() -> None:
    T, info = run()
    off = np.asarray(se3_log(inverse(se3_exp(jnp.asarray(MOTION, jnp.float32))) @ T))
    assert np.linalg.norm(off[:3]) < 4e-3
    assert np.linalg.norm(off[3:]) < 3e-3
    other, same = align(jnp.eye(4), WEAK, jnp.eye(4), FREE, REFERENCE, OBSERVED, CAMERA, CONFIG)
    assert np.linalg.norm(np.asarray(se3_log(inverse(other) @ T))[:3]) < 4e-3
    assert abs(float(info.inlier_share - same.inlier_share)) < 0.1
    assert int(info.iterations) == 1000
    assert info.information.shape == (6, 6)


def test_keys_differ_by_less_than_a_few_millimetres() -> None:
    """The mean over the last quarter of the steps removes most of the random variation."""
    poses = [np.asarray(run(key)[0]) for key in range(4)]
    assert np.ptp([T[:3, 3] for T in poses], axis=0).max() < 4e-3
    assert np.ptp([T[:3, 3] for T in poses], axis=0).max() > 0.0


def test_a_strong_prior_holds() -> None:
    prior = se3_exp(jnp.asarray(MOTION + 0.01, jnp.float32))
    T, _ = run(precision=1e9 * jnp.eye(6), prior=prior)
    assert np.linalg.norm(np.asarray(se3_log(inverse(prior) @ T))) < 2e-3


def test_a_planar_basis_is_kept_exactly() -> None:
    """A basis of forward, left and turn of a body below a tilted camera adds no height, roll or pitch."""
    T_body_cam = camera_pose((0.05, 0.0, 0.4), 0.2, 0.1)
    twists = np.zeros((6, 3))
    for i, column in enumerate((0, 1, 5)):
        h = np.zeros(6)
        h[column] = 1e-3
        moved = np.linalg.inv(T_body_cam) @ np.asarray(se3_exp(jnp.asarray(h, jnp.float32)), float) @ T_body_cam
        twists[:, i] = np.asarray(se3_log(jnp.asarray(moved, jnp.float32))) / 1e-3
    T, _ = run(basis=jnp.asarray(twists, jnp.float32), precision=1e-3 * jnp.eye(3))
    moved = T_body_cam @ np.asarray(T, float) @ np.linalg.inv(T_body_cam)
    assert abs(moved[2, 3]) < 2e-4
    np.testing.assert_allclose(moved[2, :3], [0.0, 0.0, 1.0], atol=1e-3)


def test_no_depth_leaves_the_prior() -> None:
    """Without pixels to align the result is the prior's mean, with zero coverage and no NaN."""
    blind = jax.tree.map(jnp.zeros_like, OBSERVED)
    T, info = run(observed=blind)
    np.testing.assert_allclose(np.asarray(T), np.eye(4), atol=1e-6)
    assert float(info.coverage) == 0.0
    assert all(np.isfinite(np.asarray(a)).all() for a in jax.tree.leaves(info))


def loss_by_hand(T: np.ndarray, pixels: np.ndarray) -> float:
    """Return the published loss over given pixels, one at a time, float64."""
    ref = jax.tree.map(np.asarray, make_reference(REFERENCE, CAMERA, CONFIG))
    obs = jax.tree.map(np.asarray, make_observed(OBSERVED, CAMERA))
    total = 0.0
    for k in pixels:
        q = T[:3, :3] @ obs.points[:, k] + T[:3, 3]
        u, v = CAMERA.fx * q[0] / q[2] + CAMERA.cx, CAMERA.fy * q[1] / q[2] + CAMERA.cy
        i, j = int(np.round(u)), int(np.round(v))
        if q[2] <= 0.05 or not (0 <= i < CAMERA.width and 0 <= j < CAMERA.height):
            continue
        at = j * CAMERA.width + i
        normal, offset = ref.plane[:3, at], ref.plane[3, at]
        r_geo = abs(offset - normal @ q)
        if normal @ normal < 0.5 or r_geo >= 0.45:
            continue
        total += r_geo / 0.02
        grey, du, dv = ref.image[:, at]
        r_rgb = abs(grey + du * (u - i) + dv * (v - j) - obs.luminance[k])
        if ref.textured[at] and r_rgb < 0.15:
            total += 3.0 * r_rgb / 0.1
    return total


def data_loss(T: jax.Array, pixels: np.ndarray) -> jax.Array:
    ref, obs = make_reference(REFERENCE, CAMERA, CONFIG), make_observed(OBSERVED, CAMERA)
    reference, observed, _, _ = adam._rows(ref, obs)
    return adam.data_loss(T, reference, observed[pixels], CAMERA, ADAM)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_loss_is_the_published_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, CAMERA.width * CAMERA.height, 60)
    T = np.asarray(se3_exp(jnp.asarray(0.02 * rng.standard_normal(6), jnp.float32)))
    np.testing.assert_allclose(
        float(data_loss(jnp.asarray(T), pixels)), loss_by_hand(T.astype(float), pixels), rtol=2e-3
    )


def test_the_gradient_is_that_of_finite_differences() -> None:
    """It is compared between two jumps of association, in every direction, for one pixel at a time."""
    slope = jax.jit(jax.grad(lambda xi, pixel: data_loss(se3_exp(xi), pixel[None])))
    value = jax.jit(lambda xi, pixel: data_loss(se3_exp(xi), pixel[None]))
    rng, agreed, h = np.random.default_rng(5), 0, 2e-4
    for pixel in rng.integers(0, CAMERA.width * CAMERA.height, 40):
        xi = jnp.asarray(0.01 * rng.standard_normal(6), jnp.float32)
        direction = jnp.asarray(rng.standard_normal(6), jnp.float32)
        at = jnp.asarray(pixel)
        difference = float(value(xi + h * direction, at) - value(xi - h * direction, at)) / (2.0 * h)
        derivative = float(slope(xi, at) @ direction)
        agreed += abs(derivative - difference) < 0.05 * abs(difference) + 0.5
    assert agreed >= 34  # a kink of |r| or another pixel in between spoils a few


def test_adam_without_momentum_by_hand() -> None:
    """Two steps on a quadratic: x - a g / sqrt(v / (1 - b^t)), v the running mean of g^2; the last quarter's mean."""
    config = AdamConfig(steps=2, translation_step=0.1, rotation_step=0.01, decay=0.9, averaged=0.5)
    basis = jnp.eye(6)[:, jnp.array([0, 5])]
    got = minimise(lambda x, i: 2.0 * x[0] ** 2 + 3.0 * x[1] ** 2, jnp.array([1.0, 1.0]), basis, config)
    x, v = np.array([1.0, 1.0]), np.zeros(2)
    for t in (1, 2):
        g = np.array([4.0, 6.0]) * x
        v = 0.9 * v + 0.1 * g * g
        x = x - np.array([0.1, 0.01]) * g / np.sqrt(v / (1.0 - 0.9**t))
    np.testing.assert_allclose(np.asarray(got), x, rtol=1e-5)


def test_one_key_one_result() -> None:
    a, b = (run(1)[0] for _ in range(2))
    np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
