"""Test the transition's part of a smoothed trajectory against dense systems in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.inference.smoothing.chain import chain_equations, of_poses
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.model.transition import Imu, ImuNoise, MotionNoise, Planar, Rigid, RigidNoise, Transition

TRANSITIONS: dict[str, Transition] = {
    "planar": Planar(MotionNoise(0.05, 0.02)),
    "rigid": Rigid(RigidNoise(0.15, 0.02, 0.3, 0.02)),
    "imu": Imu(ImuNoise(0.02, 0.01, 0.05, 0.05)),
}
TIME = 5
DT = jnp.asarray([0.1, 0.2, 0.1, 0.15])


def system(name: str):
    """Return a transition, a start, states along which it does not quite move, and controls."""
    transition = TRANSITIONS[name]
    manifold, rng = transition.manifold, np.random.default_rng(0)
    n = len(manifold.turns)
    xi = jnp.asarray(rng.normal(0.0, 0.05, (TIME, n)), jnp.float32)
    start = at_rest(manifold, jnp.eye(4), 0.01 * jnp.eye(manifold.twists.shape[1]), (0.5, 0.5))
    controls = jnp.asarray(rng.normal(0.0, 0.1, (TIME - 1, transition.controls)), jnp.float32)
    states = [start.mean]
    for u, dt in zip(controls, DT, strict=True):
        states.append(transition.mean(states[-1], u, dt))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    return transition, start, manifold.perturb(stacked, xi), controls


def dense(chain) -> np.ndarray:
    time, n = chain.gradient.shape
    H = np.zeros((time * n, time * n))
    for t in range(time):
        H[n * t : n * t + n, n * t : n * t + n] = chain.diagonal[t]
        if t:
            H[n * t : n * t + n, n * (t - 1) : n * t] = chain.below[t - 1]
            H[n * (t - 1) : n * t, n * t : n * t + n] = chain.below[t - 1].T
    return H


@pytest.mark.parametrize("name", TRANSITIONS)
def test_the_gradient_is_that_of_the_log_density(name):
    """It is that of the squared errors: the noise is that of the state to linearise about."""
    transition, start, states, controls = system(name)
    manifold = transition.manifold
    at = lambda tree, t: jax.tree.map(lambda leaf: leaf[t], tree)
    P = jnp.linalg.inv(start.covariance)
    W = [jnp.linalg.inv(transition.noise_covariance(at(states, t), controls[t], DT[t])) for t in range(TIME - 1)]

    def cost(xi):
        moved = manifold.perturb(states, xi)
        e = manifold.error(start.mean, at(moved, 0))
        total = 0.5 * e @ P @ e
        for t in range(TIME - 1):
            e = manifold.error(transition.expected(at(moved, t), controls[t], DT[t]), at(moved, t + 1))
            total += 0.5 * e @ W[t] @ e
        return total

    expected = np.asarray(jax.grad(cost)(jnp.zeros((TIME, len(manifold.turns)))))
    found = chain_equations(transition, start, states, controls, DT).gradient
    # The belief over the start is linearised with a Jacobian of one.
    np.testing.assert_allclose(found[1:], expected[1:], rtol=2e-3, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(found[0], expected[0], rtol=0.1, atol=0.03 * np.abs(expected).max())


@pytest.mark.parametrize("name", TRANSITIONS)
def test_what_is_no_pose_is_integrated_out_as_in_a_dense_system(name):
    transition, start, states, controls = system(name)
    chain = chain_equations(transition, start, states, controls, DT)
    p, n = transition.manifold.twists.shape[1], len(transition.manifold.turns)
    found = of_poses(chain, p)
    rng = np.random.default_rng(1)
    root = rng.normal(size=(TIME * p, TIME * p))
    data, gradient = 1e3 * root @ root.T, 1e3 * rng.normal(size=TIME * p)
    pose = np.tile(np.arange(n) < p, TIME)
    H, g = dense(chain), chain.gradient.reshape(-1).copy()
    H[np.ix_(pose, pose)] += data
    g[pose] += gradient
    x, covariance = np.linalg.solve(H, -g), np.linalg.inv(H)
    xi = np.linalg.solve(found.hessian + data, -(found.gradient + gradient))
    np.testing.assert_allclose(xi, x[pose], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.rest + found.by_poses @ xi, x[~pose], rtol=1e-6, atol=1e-6)
    poses = np.linalg.inv(found.hessian + data)
    np.testing.assert_allclose(poses, covariance[np.ix_(pose, pose)], rtol=1e-5, atol=1e-9)
    rest = covariance[np.ix_(~pose, ~pose)]
    around = found.by_poses @ poses @ found.by_poses.T
    for t in range(TIME):
        block = slice((n - p) * t, (n - p) * (t + 1))
        np.testing.assert_allclose(
            around[block, block] + found.rest_covariance[t], rest[block, block], rtol=1e-5, atol=1e-9
        )
