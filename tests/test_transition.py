"""The planar transition against simulation: the noise of SPEC 6, drawn without its rectification and as executed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.geometry import inverse, matrix_to_planar, planar_to_matrix
from vssm_gym.transition import MotionNoise, PlanarBelief, planar_mean, planar_predict

NOISE = ExecutionNoise(turn=np.radians(1.0), step=0.004)  # small against every command below: nothing is rectified
# turning left and right, driving, both, and neither
COMMANDS = [
    (0.15, 0.0, 0.0),
    (-0.15, 0.0, 0.0),
    (0.0, 0.05, 0.12),
    (0.2, 0.08, 0.15),
    (-0.2, -0.08, 0.15),
    (0.0, 0.0, 0.0),
]
START = np.array([0.4, -0.7, 2.9])  # near pi: turning left wraps
SAMPLES = 40_000

commands = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.08, 0.08), st.floats(0.0, 0.16)).map(np.array)
planars = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.14, 3.14)).map(np.array)


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def body_frame_errors(mean: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """``xi`` (n, 3) of ``T = T_mean exp(xi)``, to first order in the rotation."""
    return matrix_to_planar(inverse(planar_to_matrix(mean)) @ planar_to_matrix(samples))


def spec6(planar: np.ndarray, command: np.ndarray, noise: ExecutionNoise, rng: np.random.Generator) -> np.ndarray:
    """SPEC 6 for many robots (n, 3) at once; the sign of a turn flips its noise, the direction's it does not."""
    turn, offset, step = command
    e_a, e_s = rng.normal(0.0, noise.turn, len(planar)), rng.normal(0.0, noise.step, len(planar))
    turned = np.sign(turn) * np.maximum(0.0, abs(turn) + e_a)
    moved = np.maximum(0.0, step + e_s) if step > 0 else np.zeros(len(planar))
    phi = planar[:, 2] + offset + e_a
    return np.stack([planar[:, 0] + moved * np.cos(phi), planar[:, 1] + moved * np.sin(phi), planar[:, 2] + turned], 1)


def assert_covariances_agree(predicted: np.ndarray, errors: np.ndarray, tolerance: float = 0.04) -> None:
    """Entry by entry, in units of the predicted standard deviations."""
    empirical = np.cov(errors.T)
    spread = np.sqrt(np.maximum(np.diag(predicted), 1e-10))
    np.testing.assert_allclose(
        empirical / np.outer(spread, spread), predicted / np.outer(spread, spread), atol=tolerance
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_from_a_known_pose_agrees_with_simulation(command: tuple[float, float, float]) -> None:
    u = np.array(command)
    samples = spec6(np.tile(START, (SAMPLES, 1)), u, NOISE, np.random.default_rng(1))
    belief = PlanarBelief(f32(START), jnp.zeros((3, 3)))
    predicted = planar_predict(belief, f32(u), MotionNoise(NOISE.turn, NOISE.step))
    errors = body_frame_errors(np.asarray(predicted.planar, float), samples)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=2e-4)
    assert_covariances_agree(np.asarray(predicted.covariance, float), errors)


@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_of_a_belief_agrees_with_simulation(command: tuple[float, float, float]) -> None:
    """The old uncertainty is carried along: correlated, and larger than the noise of the step."""
    u, rng = np.array(command), np.random.default_rng(2)
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.01, 0.015, 0.02]])
    xi = rng.standard_normal((SAMPLES, 3)) @ root.T
    starts = matrix_to_planar(planar_to_matrix(START) @ planar_to_matrix(xi))
    samples = spec6(starts, u, NOISE, rng)
    belief = PlanarBelief(f32(START), f32(root @ root.T))
    predicted = planar_predict(belief, f32(u), MotionNoise(NOISE.turn, NOISE.step))
    errors = body_frame_errors(np.asarray(predicted.planar, float), samples)
    assert_covariances_agree(np.asarray(predicted.covariance, float), errors)


@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_agrees_with_the_environments_robot(command: tuple[float, float, float]) -> None:
    u, rng = np.array(command), np.random.default_rng(3)
    samples = np.stack([execute(START, u, NOISE, rng) for _ in range(6000)])
    belief = PlanarBelief(f32(START), jnp.zeros((3, 3)))
    predicted = planar_predict(belief, f32(u), MotionNoise(NOISE.turn, NOISE.step))
    errors = body_frame_errors(np.asarray(predicted.planar, float), samples)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=1e-3)
    assert_covariances_agree(np.asarray(predicted.covariance, float), errors, tolerance=0.08)


@given(planars, commands)
def test_the_mean_is_the_noise_free_robot(planar: np.ndarray, command: np.ndarray) -> None:
    expected = execute(planar, command, ExecutionNoise(0.0, 0.0), np.random.default_rng(0))
    mean = np.asarray(planar_mean(f32(planar), f32(command)), float)
    np.testing.assert_allclose(mean[:2], expected[:2], atol=1e-5)
    assert abs(np.exp(1j * mean[2]) - np.exp(1j * expected[2])) < 1e-5
    assert -np.pi - 1e-6 <= mean[2] <= np.pi + 1e-6


def test_the_mean_by_hand() -> None:
    """At heading 0: drive 0.1 m at 30 degrees to the left, then face 0.2 rad."""
    mean = planar_mean(jnp.zeros(3), jnp.array([0.2, np.pi / 6, 0.1]))
    np.testing.assert_allclose(np.asarray(mean), [0.1 * np.sqrt(3) / 2, 0.05, 0.2], rtol=1e-5)


def test_a_robot_that_does_not_move_stays_as_certain() -> None:
    covariance = f32(np.diag([0.01, 0.02, 0.03]))
    stood = planar_predict(PlanarBelief(f32(START), covariance), jnp.zeros(3), MotionNoise(0.5, 0.5))
    np.testing.assert_allclose(np.asarray(stood.planar), START, atol=1e-6)
    np.testing.assert_allclose(np.asarray(stood.covariance), np.asarray(covariance), atol=1e-7)


@given(planars, commands, st.integers(0, 2**32 - 1))
def test_covariances_stay_symmetric_and_positive(planar: np.ndarray, command: np.ndarray, seed: int) -> None:
    root = np.random.default_rng(seed).normal(scale=0.05, size=(3, 3))
    belief = PlanarBelief(f32(planar), f32(root @ root.T))
    covariance = np.asarray(planar_predict(belief, f32(command), MotionNoise(0.05, 0.02)).covariance, float)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-7)
    assert np.linalg.eigvalsh(covariance).min() > -1e-7


def test_means_take_batches() -> None:
    planar, control = jnp.ones((4, 5, 3)), jnp.full((4, 5, 3), 0.1)
    batch = planar_mean(planar, control)
    np.testing.assert_allclose(
        np.asarray(batch), np.asarray(jnp.broadcast_to(planar_mean(planar[0, 0], control[0, 0]), (4, 5, 3)))
    )
