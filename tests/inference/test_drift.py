"""Test the drift of the map's frame: when it grows, and what it adds to a pose."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from tests.helpers.prism_room import CONFIG, copy, image, start, step, walked
from vssm_gym.geometry.transforms import inverse, se3_adjoint
from vssm_gym.inference.prism import drift
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.error_covariance import Considered, nothing
from vssm_gym.model.transition import GaussianBelief, RigidState, rigid_belief


def twist_matrix(xi: np.ndarray) -> np.ndarray:
    """Return ``xi^`` ``(..., 4, 4)`` of twists ``(..., 6)``."""
    X = np.zeros((*xi.shape[:-1], 4, 4))
    X[..., :3, :3] = np.cross(np.eye(3), xi[..., None, 3:])
    X[..., :3, 3] = xi[..., :3]
    return X


def series(A: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """Return ``sum_n c_n A^n``, n = 1, 2, ...: to 1e-9 for the small matrices ``(..., 4, 4)`` here."""
    total, power = np.zeros_like(A), np.eye(4)
    for c in coefficients:
        power = power @ A
        total = total + c * power
    return total


def small_exp(xi: np.ndarray) -> np.ndarray:
    return np.eye(4) + series(twist_matrix(xi), [1.0 / math.factorial(n) for n in range(1, 12)])


def small_log(T: np.ndarray) -> np.ndarray:
    return series(T - np.eye(4), [(-1.0) ** (n + 1) / n for n in range(1, 12)])


def belief_of(T: np.ndarray, covariance: np.ndarray) -> GaussianBelief:
    full = np.zeros((12, 12))
    full[:6, :6] = covariance
    return rigid_belief(RigidState(jnp.asarray(T, jnp.float32), jnp.zeros(6)), jnp.asarray(full, jnp.float32))


def random_covariance(rng: np.random.Generator, std: float) -> np.ndarray:
    root = rng.standard_normal((6, 9)) / 3.0
    return std**2 * root @ root.T


def of_drift(P: np.ndarray, cross: np.ndarray | None = None) -> Considered:
    """Return what is considered: a drift of covariance P and, 6 x 12, its covariance with the state's error."""
    none = nothing(12)
    frames_state = none.frames_state if cross is None else jnp.tile(jnp.asarray(cross, jnp.float32), (2, 1))
    return replace(none, frames=jnp.tile(jnp.asarray(P, jnp.float32), (2, 2)), frames_state=frames_state)


@pytest.mark.parametrize("seed", range(3))
def test_in_world_is_the_covariance_of_a_pose_in_an_uncertain_frame(seed: int) -> None:
    """It equals samples in float64 of ``exp(d) T exp(e)`` with ``(d, e)`` of any joint covariance."""
    rng = np.random.default_rng(seed)
    T = expm(twist_matrix(rng.standard_normal(6)))
    root = rng.standard_normal((12, 16)) / 4.0
    joint = (root @ root.T) * np.outer(np.repeat([0.01, 0.005], 6), np.repeat([0.01, 0.005], 6))
    cross = np.zeros((6, 12))
    cross[:, :6] = joint[:6, 6:]
    belief = belief_of(T, joint[6:, 6:])
    got = of_drift(joint[:6, :6], cross).in_world(belief)
    d, e = np.split(rng.multivariate_normal(np.zeros(12), joint, 4000), 2, axis=1)
    X = small_log(np.linalg.inv(T) @ small_exp(d) @ T @ small_exp(e))
    off = np.stack([X[:, 0, 3], X[:, 1, 3], X[:, 2, 3], X[:, 2, 1], X[:, 0, 2], X[:, 1, 0]], axis=-1)
    sampled = off.T @ off / len(off)
    scale = np.sqrt(np.diag(sampled))
    normed = np.asarray(got.covariance, float)[:6, :6] / np.outer(scale, scale)
    np.testing.assert_allclose(normed, sampled / np.outer(scale, scale), atol=0.1)
    np.testing.assert_array_equal(got.covariance[6:, 6:], belief.covariance[6:, 6:])


def test_an_image_writes_its_share_of_the_map_in_view() -> None:
    """By hand: a quarter of the readings is new, a quarter observed by one image, half outside of the map."""
    seen = image(12)
    n = seen.hit[2::4, 2::4].size
    assert bool(seen.hit.all())
    old = jnp.repeat(jnp.asarray([0.01, 1.0, 7.0, 7.0]), n // 4, total_repeat_length=n)
    new = jnp.repeat(jnp.asarray([1.01, 2.0, 7.0, 7.0]), n // 4, total_repeat_length=n)
    assert float(drift.share(old, new, seen)) == pytest.approx(0.25 * (1.0 - 0.01 / 1.01) + 0.25 * 0.5, rel=1e-3)
    assert float(drift.share(old, new, jax.tree.map(jnp.zeros_like, seen))) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_the_frame_takes_over_the_error_that_it_is_written_with(seed: int) -> None:
    """The covariances of ``m = d + nu Ad_T e`` with itself and with ``e``, of any joint covariance, in float64."""
    rng = np.random.default_rng(seed)
    T = expm(twist_matrix(rng.standard_normal(6)))
    root = rng.standard_normal((12, 16)) / 400.0
    joint, share = root @ root.T, 0.3
    cross = np.zeros((6, 12))
    cross[:, :6] = joint[:6, 6:]
    belief = belief_of(T, joint[6:, 6:])
    written = of_drift(joint[:6, :6], cross).write(belief, jnp.float32(share))
    carry = np.eye(12)
    carry[:6, 6:] = share * np.asarray(se3_adjoint(jnp.asarray(T, jnp.float32)), float)
    expected = carry @ joint @ carry.T
    np.testing.assert_allclose(written.drift, expected[:6, :6], atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(written.frames_state[6:, :6], expected[:6, 6:], atol=1e-3 * np.abs(expected).max())
    still = of_drift(joint[:6, :6], cross).write(belief, jnp.float32(0.0))
    np.testing.assert_allclose(still.drift, of_drift(joint[:6, :6]).drift, rtol=1e-6)


def location_stds(frames, rate: float) -> np.ndarray:
    """Return the std of the drift of the body's location after each image, m."""
    state, found = start(), []
    for k in frames:
        state, info = step(state, image(k), 1.0 / rate)
        assert info.status == Status.OK
        back = np.asarray(se3_adjoint(inverse(state.past.T_world_cam)), float)
        found.append(np.trace((back @ np.asarray(state.past.considered.drift, float) @ back.T)[:3, :3]))
    return np.sqrt(found)


@pytest.mark.slow
def test_a_standing_camera_soon_stops_drifting() -> None:
    """The last ten of forty images of one place add a tenth of the drift at most; the n-th writes 1/n of the map."""
    still = location_stds([0] * 40, 10.0)
    assert still[-1] - still[-10] < 0.1 * still[-1]


def test_drift_in_new_space_does_not_depend_on_the_rate() -> None:
    """In steps of a half and of a third of the same walk, the drift depends on the path, not on time."""
    coarse = location_stds(np.arange(2.0, 25.0, 2.0), 5.0)
    fine = location_stds(np.arange(1.0, 25.0, 1.0), 10.0)
    assert coarse[-1] > 2.0 * coarse[0]
    assert fine[-1] == pytest.approx(coarse[-1], rel=0.5)


def test_the_scale_of_the_depth_moves_a_pose_along_its_displacement() -> None:
    """With a scale of ``s_d`` all else is equal, and the covariance grows by that of a pose that far from the first."""
    T_first = small_exp(np.array([0.4, -0.3, 0.2, 0.3, -0.5, 0.2]))
    grown = []
    for std in (CONFIG.scale_std, 0.0):
        config = replace(CONFIG, scale_std=std)
        state = start(config, T_world_body=jnp.asarray(T_first, jnp.float32))
        for k in (1.0, 2.0, 3.0):
            state, info = step(state, image(k), config=config)
        grown.append(np.asarray(info.belief.covariance, float))
    T = np.asarray(info.belief.mean.T_world_body, float)
    away = np.concatenate([T[:3, :3].T @ (T[:3, 3] - T_first[:3, 3]), np.zeros(3)])
    added = (grown[0] - grown[1])[:6, :6] / CONFIG.scale_std**2
    assert np.linalg.norm(away) > 0.05
    np.testing.assert_allclose(added, np.outer(away, away), atol=0.02 * (away @ away))


def test_a_belief_in_the_world_includes_the_drift() -> None:
    """It is that against the map with the drift, where the image was accepted and where it was not."""
    state, infos = walked()
    blind = jax.tree.map(jnp.zeros_like, image(0))
    lost, blindly = step(copy(state), blind)
    assert (infos[-1].status, blindly.status) == (Status.OK, Status.NO_READING)
    for after, info in ((state, infos[-1]), (lost, blindly)):
        T = after.past.belief.mean.T_world_body
        back = np.asarray(se3_adjoint(inverse(T)), float)
        considered = after.past.considered
        cross = back @ np.asarray(considered.frames_state, float)[:6, :6]
        carried = back @ np.asarray(considered.frames, float)[:6, :6] @ back.T + cross + cross.T
        later = CONFIG.stamp_std * np.asarray(after.past.belief.mean.velocity, float)
        R = np.asarray(T, float)[:3, :3]
        moved = np.concatenate([R.T @ later[:3], R.T @ later[3:]])
        away = np.concatenate([R.T @ (np.asarray(T, float)[:3, 3] - np.asarray(after.start, float)), np.zeros(3)])
        carried += np.outer(moved, moved) + CONFIG.calibration_std**2 * np.eye(6)
        carried += CONFIG.scale_std**2 * np.outer(away, away)
        covariance = np.asarray(info.belief.covariance, float)
        grown = covariance - np.asarray(after.past.belief.covariance, float)
        std = np.sqrt(np.diag(covariance)[:6])
        np.testing.assert_allclose(grown[:6, :6] / np.outer(std, std), carried / np.outer(std, std), atol=1e-3)
        assert np.trace(np.asarray(considered.drift)) > 0.0
        np.testing.assert_array_equal(grown[6:, 6:], 0.0)
