"""Test the drift of the map's frame: when it grows, and what it adds to a pose."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from tests.helpers.prism_room import copy, image, start, step, walked
from vssm_gym.inference.prism import drift
from vssm_gym.inference.prism.config import HAND_HELD
from vssm_gym.inference.status import Status
from vssm_gym.model.transition import GaussianBelief, RigidState, rigid_belief

ALIKE = HAND_HELD.correlated_images


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


@pytest.mark.parametrize("seed", range(3))
def test_in_world_is_the_covariance_of_a_pose_in_an_uncertain_frame(seed: int) -> None:
    """It equals samples in float64 of ``exp(p) T exp(e)``, ``p ~ N(0, P)``, ``e ~ N(0, Sigma)``."""
    rng = np.random.default_rng(seed)
    T = expm(twist_matrix(rng.standard_normal(6)))
    P, S = random_covariance(rng, 0.01), random_covariance(rng, 0.005)
    got = drift.in_world(belief_of(T, S), jnp.asarray(P, jnp.float32))
    p, e = (rng.multivariate_normal(np.zeros(6), C, 4000) for C in (P, S))
    X = small_log(np.linalg.inv(T) @ small_exp(p) @ T @ small_exp(e))
    off = np.stack([X[:, 0, 3], X[:, 1, 3], X[:, 2, 3], X[:, 2, 1], X[:, 0, 2], X[:, 1, 0]], axis=-1)
    sampled = off.T @ off / len(off)
    scale = np.sqrt(np.diag(sampled))
    normed = np.asarray(got.covariance, float)[:6, :6] / np.outer(scale, scale)
    np.testing.assert_allclose(normed, sampled / np.outer(scale, scale), atol=0.1)
    np.testing.assert_array_equal(got.covariance[6:], belief_of(T, S).covariance[6:])


def test_the_frame_drifts_by_the_proportion_that_the_image_wrote() -> None:
    """By hand: a quarter of the readings is new, a quarter observed by one image, half outside of the map."""
    before = 1e-6 * jnp.eye(6)
    T = np.asarray(walked()[1][-1].belief.mean.T_world_body, float)
    S = random_covariance(np.random.default_rng(0), 0.002)
    seen = image(12)
    n = seen.hit[2::4, 2::4].size
    assert bool(seen.hit.all())
    old = jnp.repeat(jnp.asarray([0.01, 1.0, 7.0, 7.0]), n // 4, total_repeat_length=n)
    new = jnp.repeat(jnp.asarray([1.01, 2.0, 7.0, 7.0]), n // 4, total_repeat_length=n)
    grown = np.asarray(drift.grow(before, old, new, belief_of(T, S), seen, ALIKE), float) - np.asarray(before, float)
    carry = np.asarray(drift.se3_adjoint(jnp.asarray(T, jnp.float32)), float)
    expected = ALIKE * (0.25 * (1.0 - 0.01 / 1.01) + 0.25 * 0.5) * carry @ S @ carry.T
    np.testing.assert_allclose(grown, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    none = jax.tree.map(jnp.zeros_like, seen)
    np.testing.assert_array_equal(drift.grow(before, old, new, belief_of(T, S), none, ALIKE), before)


def shares(frames, rate: float) -> np.ndarray:
    """Return ``k nu`` of each step, from the growth of the drift seen from the body and the pose's covariance."""
    state, found = start(), []
    for k in frames:
        before = np.asarray(state.drift, float)
        state, info = step(state, image(k), 1.0 / rate)
        assert info.status == Status.OK
        back = np.asarray(drift.se3_adjoint(drift.inverse(state.past.T_world_cam)), float)
        grown = back @ (np.asarray(state.drift, float) - before) @ back.T
        found.append(np.trace(grown[:3, :3]) / np.trace(np.asarray(state.past.belief.covariance, float)[:3, :3]))
    return np.array(found)


def test_a_standing_camera_soon_stops_drifting() -> None:
    """The n-th image of one place writes 1/n of it at most (cells at the image's rim are written by fewer)."""
    still = shares([0] * 40, 10.0) / ALIKE
    assert (still <= 1.05 / np.arange(2, 42)).all()
    assert still[-10:].sum() < 0.3


def test_drift_in_new_space_does_not_depend_on_the_rate() -> None:
    """In steps of a half and of a third of the same walk, the drift depends on the path, not on time."""
    coarse, fine = shares(np.arange(2.0, 25.0, 2.0), 5.0), shares(np.arange(1.0, 25.0, 1.0), 10.0)
    assert coarse.sum() / ALIKE > 1.0
    assert fine.sum() == pytest.approx(coarse.sum(), rel=0.5)


def test_a_belief_in_the_world_includes_the_drift() -> None:
    """The covariance of a step is ``Sigma + Ad^-1 P Ad^-T``, where the image was accepted and where it was not."""
    state, infos = walked()
    blind = jax.tree.map(jnp.zeros_like, image(0))
    lost, blindly = step(copy(state), blind)
    assert (infos[-1].status, blindly.status) == (Status.OK, Status.NO_READING)
    for after, info in ((state, infos[-1]), (lost, blindly)):
        T = np.asarray(after.past.belief.mean.T_world_body, float)
        back = np.linalg.inv(np.asarray(drift.se3_adjoint(jnp.asarray(T, jnp.float32)), float))
        carried = back @ np.asarray(after.drift, float) @ back.T
        covariance = np.asarray(info.belief.covariance, float)
        grown = covariance - np.asarray(after.past.belief.covariance, float)
        std = np.sqrt(np.diag(covariance)[:6])
        np.testing.assert_allclose(grown[:6, :6] / np.outer(std, std), carried / np.outer(std, std), atol=1e-4)
        assert np.trace(grown[:3, :3]) > 0.0
        np.testing.assert_array_equal(grown[6:], 0.0)
