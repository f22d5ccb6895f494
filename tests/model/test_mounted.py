"""Test a learned transition seen from the body's camera against the body's own motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.dynamics.transitions import noisy_transition, random_transition
from vssm_gym.geometry.transforms import inverse, se3_exp
from vssm_gym.model.transition import Imu, RigidState
from vssm_gym.model.transition.mounted import Mounted
from vssm_gym.model.transition.with_rest import RestState

DT = 0.1  # s
CONTROL = jnp.array([0.3, -0.5, 9.6, 0.4, -0.2, 0.7])
LEVEL, MOUNT = (
    se3_exp(jnp.asarray(twist)) for twist in ([0.0, 0.0, 0.0, 0.4, -0.7, 0.2], [0.3, -0.1, 0.2, 1.0, 0.5, 2.0])
)


def some_state(size: int, seed: int = 0) -> RestState:
    rng = np.random.default_rng(seed)
    numbers = [jnp.asarray(rng.normal(size=n), jnp.float32) for n in (6, 6, size)]
    return RestState(RigidState(se3_exp(numbers[0]), numbers[1]), numbers[2])


def same(a: RestState, b: RestState, atol: float = 1e-5) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=atol)


def test_camera_and_body_are_inverse():
    mounted = Mounted(random_transition(), LEVEL, MOUNT)
    state = some_state(2)
    same(mounted.to_camera(mounted.to_body(state)), state)


def test_a_camera_at_the_origin_of_a_level_body_is_the_body():
    learned, state = random_transition(), some_state(2)
    mounted = Mounted(learned, jnp.eye(4), jnp.eye(4))
    same(mounted.mean(state, CONTROL, DT), learned.mean(state, CONTROL, DT))
    expected = learned.noise_covariance(state, CONTROL, DT)
    np.testing.assert_allclose(mounted.noise_covariance(state, CONTROL, DT), expected, rtol=1e-3, atol=1e-6)


def test_the_camera_moves_as_the_body_that_carries_it():
    """Its velocity is that of its place: the difference of its positions over a short time."""
    mounted, state = Mounted(noisy_transition(Imu(), (0.02, 0.01, 0.05, 0.05), 15), LEVEL, MOUNT), some_state(8)
    body = mounted.to_body(state)
    path = mounted.learned.mean_path(body, jnp.tile(CONTROL, (5, 1)), DT)
    seen = mounted.mean_path(state, jnp.tile(CONTROL, (5, 1)), DT)
    T = inverse(LEVEL) @ path.body.T_world_body @ MOUNT
    np.testing.assert_allclose(seen.body.T_world_body, T, atol=1e-4)
    w = np.asarray(state.body.velocity[3:])
    later = mounted.to_camera(
        RestState(RigidState(moved_by(body.body, 1e-2), body.body.velocity), body.rest)
    ).body.T_world_body
    speed = (np.asarray(later) - np.asarray(state.body.T_world_body))[:3, 3] / 1e-2
    np.testing.assert_allclose(speed, state.body.velocity[:3], atol=0.03 * (1.0 + np.linalg.norm(w) ** 2))


def moved_by(state: RigidState, seconds: float) -> jax.Array:
    """Return the pose after a short time at constant velocities in the world."""
    T, v = state.T_world_body, state.velocity
    turn = se3_exp(jnp.concatenate([jnp.zeros(3), v[3:] * seconds]))
    T = T.at[:3, :3].set(turn[:3, :3] @ T[:3, :3])
    return T.at[:3, 3].add(v[:3] * seconds)


@pytest.mark.slow
def test_its_noise_is_that_of_the_body_seen_from_the_camera():
    """The covariance of sampled steps of the body, each seen from the camera."""
    mounted, state = Mounted(random_transition(spread=0.05), LEVEL, MOUNT), some_state(2)
    small = eqx.tree_at(lambda m: m.learned.scales.errors, mounted, 0.02 * mounted.learned.scales.errors)
    count = 20_000
    body = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), small.to_body(state))
    drawn = small.learned.sample(jax.random.key(0), body, jnp.broadcast_to(CONTROL, (count, 6)), DT)
    xi = np.asarray(small.manifold.error(small.mean(state, CONTROL, DT), small.to_camera(drawn)), float)
    expected = np.asarray(small.noise_covariance(state, CONTROL, DT), float)
    spread = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(xi.T) / np.outer(spread, spread), expected / np.outer(spread, spread), atol=0.05)
