"""Test displacements by the errors of poses: rigid motions are exact, moments against sums over a dense covariance."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.maps.pose_errors import PoseErrors

CAMERA = Camera.from_hfov(64, 48, np.radians(90))
POSES = np.array([camera_pose((-1.0 + 0.2 * k, 0.1 * k, 0.2), 0.3 * k) for k in range(5)])
_ROOT = 0.01 * np.random.default_rng(3).normal(size=(5, 6, 6))
COVARIANCES = np.cumsum(_ROOT @ _ROOT.transpose(0, 2, 1), axis=0)
POINTS = np.random.default_rng(1).uniform((-1.0, -1.0, 0.0), (3.0, 2.0, 1.0), (20, 3))


def errors() -> PoseErrors:
    return PoseErrors.of(POSES, COVARIANCES, CAMERA, reach=6.0)


def oracle_weights(p: np.ndarray) -> np.ndarray:
    """Return the weights of points (n, 3) in float64, keyframe by keyframe."""
    columns = []
    for T in POSES:
        x, y, z = ((p - T[:3, 3]) @ T[:3, :3]).T
        d = np.maximum(z, 1e-3)
        u, v = x / d * CAMERA.fx / 64 + 0.5, y / d * CAMERA.fy / 48 + 0.5
        inside = [np.clip((0.5 - np.abs(s - 0.5)) / 0.075, 0.0, 1.0) for s in (u, v)]
        seen = inside[0] * inside[1] * np.clip((6.0 - z) / 0.9, 0.0, 1.0) * (z > 1e-3)
        columns.append(seen + 1e-4 / (1.0 + (x**2 + y**2 + z**2) ** 2))
    w = np.array(columns).T
    return w / w.sum(axis=1, keepdims=True)


def oracle_variance(p: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return ``var(n . u(p))`` from the dense covariance of all errors, ``Cov(xi_k, xi_l) = P_min(k, l)``."""
    K = len(POSES)
    dense = np.array([[COVARIANCES[min(k, j)] for j in range(K)] for k in range(K)])
    w, lever = oracle_weights(p), np.concatenate([np.broadcast_to(normal, p.shape), np.cross(p, normal)], axis=-1)
    return np.einsum("nk,nl,ni,klij,nj->n", w, w, lever, dense, lever)


def test_the_variance_is_that_of_the_dense_covariance() -> None:
    normal = np.array([0.36, 0.48, 0.8])
    found = errors().variance(jnp.asarray(POINTS), jnp.broadcast_to(jnp.asarray(normal), POINTS.shape))
    np.testing.assert_allclose(np.asarray(found), oracle_variance(POINTS, normal), rtol=1e-3)


def test_a_robots_error_is_the_displacement_of_the_map_around_it() -> None:
    given, p = errors(), np.array([1.0, 0.4, 0.3])
    P = np.asarray(given.planar_covariance(jnp.asarray(p, jnp.float32)), float)
    for axis in range(2):
        np.testing.assert_allclose(P[axis, axis], oracle_variance(p[None], np.eye(3)[axis]), rtol=1e-3)
    draws = jax.vmap(lambda key: given.draw(key))(jax.random.split(jax.random.key(1), 4000))
    u = np.asarray(jax.vmap(lambda drawn: given.displacement(jnp.asarray(p, jnp.float32), drawn))(draws), float)
    xi = np.cumsum(np.einsum("kij,nkj->nki", np.asarray(given.root, float), np.asarray(draws, float)), axis=1)
    turn = xi[..., 5] @ oracle_weights(p[None])[0]
    np.testing.assert_allclose(P, np.cov(np.column_stack([u[:, :2], turn]).T), rtol=0.1, atol=0.02 * P[0, 0])


def test_drawn_displacements_have_the_stated_variance() -> None:
    given, normal = errors(), np.array([0.36, 0.48, 0.8])
    keys = jax.random.split(jax.random.key(0), 4000)
    u = np.asarray(jax.vmap(lambda key: given.displacement(jnp.asarray(POINTS), given.draw(key)))(keys), float)
    spread = (u @ normal).std(axis=0)
    np.testing.assert_allclose(spread, np.sqrt(oracle_variance(POINTS, normal)), rtol=0.06)
    assert np.abs((u @ normal).mean(axis=0)).max() < 5.0 * spread.max() / np.sqrt(len(keys))


def test_one_error_of_all_poses_moves_the_map_rigidly() -> None:
    """A walk whose first step alone is uncertain is ``exp(xi) p`` to first order, wherever the point lies."""
    first = np.zeros((5, 6, 6))
    first[:] = 1e-8 * np.eye(6)
    u = np.asarray(PoseErrors.of(POSES, first, CAMERA).displacement(jnp.asarray(POINTS), jnp.ones((5, 6))), float)
    xi = PoseErrors.of(POSES, first, CAMERA).root[0] @ jnp.ones(6)
    T = np.asarray(se3_exp(xi), float)
    np.testing.assert_allclose(u, POINTS @ T[:3, :3].T + T[:3, 3] - POINTS, atol=2e-6)


def test_points_seen_by_one_keyframe_take_its_error() -> None:
    T = np.array([camera_pose((0.0, 0.0, 0.0), 0.0), camera_pose((0.0, 0.0, 0.0), np.pi)])
    covariance = np.array([np.zeros((6, 6)), np.diag([1e-4] * 6)])
    given = PoseErrors.of(T, covariance, CAMERA)
    ahead, behind = given.variance(jnp.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]), jnp.array([[1.0, 0.0, 0.0]] * 2))
    assert float(ahead) < 1e-9
    assert float(behind) == pytest.approx(1e-4, rel=1e-3)
    np.testing.assert_allclose(np.asarray(given.weights(jnp.asarray(POINTS))).sum(axis=-1), 1.0, rtol=1e-5)


def test_a_covariance_that_shrinks_stays() -> None:
    covariance = np.array([4.0 * np.eye(6), 1.0 * np.eye(6), 9.0 * np.eye(6)])
    D = [np.asarray(r @ r.T) for r in PoseErrors.of(POSES[:3], covariance, CAMERA).root]
    np.testing.assert_allclose(D, [4.0 * np.eye(6), np.zeros((6, 6)), 5.0 * np.eye(6)], atol=1e-5)


@pytest.mark.parametrize("count", [3, 5, 12])
def test_a_ring_is_walked_back_from_its_last_keyframe(count: int) -> None:
    """The last keyframe has no error, the first one kept the whole covariance of the steps since; empty rows none."""
    ring, kept = np.tile(np.eye(4), (5, 1, 1)), min(count, 5)
    numbers = range(count - kept, count)
    for number in numbers:
        ring[number % 5, 0, 3] = number
    P = COVARIANCES[-1]
    found = PoseErrors.of_ring(jnp.asarray(ring, jnp.float32), jnp.int32(count), jnp.asarray(P, jnp.float32), CAMERA)
    np.testing.assert_array_equal(np.asarray(found.T_world_cam)[:kept, 0, 3], list(numbers)[::-1])
    np.testing.assert_array_equal(np.asarray(found.used), np.arange(5) < kept)
    D = np.asarray(found.root @ jnp.swapaxes(found.root, 1, 2), float)
    np.testing.assert_allclose(D.sum(axis=0), P * (kept - 1) / (count - 1), rtol=1e-3, atol=1e-9)
    np.testing.assert_array_equal(D[0], 0.0)
    weights = np.asarray(found.weights(jnp.asarray(POINTS, jnp.float32)))
    np.testing.assert_array_equal(weights[:, kept:], 0.0)


def test_headers_are_read_back() -> None:
    given = errors()
    again = PoseErrors.from_header("map.npz", {"pose_errors": given.to_json()})
    assert again is not None
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(given), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-6)
    assert PoseErrors.from_header("map.npz", {}) is None


CHANGES = {
    "no poses": {"T_world_cam": []},
    "not as many roots": {"root": np.zeros((2, 6, 6)).tolist()},
    "words": {"root": "none"},
    "no camera": {"camera": None},
    "a camera of no size": {"camera": [0, 48, 30.0, 30.0, 31.5, 23.5]},
    "a range of 0": {"reach": 0.0},
    "beyond float32": {"T_world_cam": (1e300 * POSES).tolist()},
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_damaged_header_is_refused(name: str) -> None:
    with pytest.raises(InputError) as raised:
        PoseErrors.from_header(Path("map.npz"), {"pose_errors": errors().to_json() | CHANGES[name]})
    assert raised.value.field.startswith("pose_errors")
