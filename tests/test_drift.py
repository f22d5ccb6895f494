"""Drift of the map's frame: what it adds to a pose, and when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from prism_room import CAMERA, image, start, walked
from scipy.linalg import expm, logm

from vssm_gym.inference import drift
from vssm_gym.transition.rigid import RigidBelief, RigidState


def twist_matrix(xi: np.ndarray) -> np.ndarray:
    X = np.zeros((4, 4))
    X[:3, :3] = np.cross(np.eye(3), xi[3:])
    X[:3, 3] = xi[:3]
    return X


def belief_of(T: np.ndarray, covariance: np.ndarray) -> RigidBelief:
    full = np.zeros((12, 12))
    full[:6, :6] = covariance
    return RigidBelief(RigidState(jnp.asarray(T, jnp.float32), jnp.zeros(6)), jnp.asarray(full, jnp.float32))


def random_covariance(rng: np.random.Generator, std: float) -> np.ndarray:
    root = rng.standard_normal((6, 9)) / 3.0
    return std**2 * root @ root.T


@pytest.mark.parametrize("seed", range(3))
def test_in_world_is_the_spread_of_a_pose_in_a_frame_that_errs(seed: int) -> None:
    """Sampled with matrix exponentials in float64: ``exp(p) T exp(e)``, ``p ~ N(0, P)``, ``e ~ N(0, Sigma)``."""
    rng = np.random.default_rng(seed)
    T = expm(twist_matrix(rng.standard_normal(6)))
    P, S = random_covariance(rng, 0.01), random_covariance(rng, 0.005)
    got = drift.in_world(belief_of(T, S), jnp.asarray(P, jnp.float32))
    off = np.empty((4000, 6))
    for i in range(len(off)):
        p, e = rng.multivariate_normal(np.zeros(6), P), rng.multivariate_normal(np.zeros(6), S)
        X = logm(np.linalg.inv(T) @ expm(twist_matrix(p)) @ T @ expm(twist_matrix(e))).real
        off[i] = *X[:3, 3], X[2, 1], X[0, 2], X[1, 0]
    sampled = off.T @ off / len(off)
    scale = np.sqrt(np.diag(sampled))
    normed = np.asarray(got.covariance, float)[:6, :6] / np.outer(scale, scale)
    np.testing.assert_allclose(normed, sampled / np.outer(scale, scale), atol=0.1)
    np.testing.assert_array_equal(got.covariance[6:], belief_of(T, S).covariance[6:])


def test_only_new_space_lets_the_frame_walk() -> None:
    """Nothing where the map has seen everything, k Sigma in a map that has seen nothing, a share of it in between."""
    state, infos = walked()
    before = 1e-6 * jnp.eye(6)
    T = np.asarray(infos[-1].belief.state.T_world_body, float)
    S = random_covariance(np.random.default_rng(0), 0.002)
    here, seen = belief_of(np.eye(4), S), image(12)

    def grown(m, relative) -> np.ndarray:
        return np.asarray(drift.grow(before, m, relative, seen, CAMERA), float) - np.asarray(before, float)

    blank = state.map.__class__.cube((0.0, 0.0, 0.0), 6.4, 0.08)
    np.testing.assert_allclose(grown(blank, here), drift.ALIKE * S, rtol=1e-3, atol=1e-10)
    # Through the trace in the body: carrying a covariance to the world makes it larger.
    back = np.asarray(drift.se3_adjoint(drift.inverse(jnp.asarray(T, jnp.float32))), float)
    known = np.trace(back @ grown(state.map, belief_of(T, S)) @ back.T) / np.trace(drift.ALIKE * S)
    assert known < 0.1
    partly = grown(start().map, belief_of(T, S))
    assert 1.5 * known < np.trace(back @ partly @ back.T) / np.trace(drift.ALIKE * S) < 0.5
    none = jax.tree.map(jnp.zeros_like, seen)
    np.testing.assert_array_equal(drift.grow(before, state.map, here, none, CAMERA), before)
