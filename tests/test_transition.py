"""The planar transition against simulation: the noise of SPEC 6, drawn without its rectification and as executed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.geometry import inverse, matrix_to_planar, planar_to_matrix, se3_exp
from vssm_gym.transition import (
    Bicycle,
    GaussianBelief,
    Imu,
    ImuNoise,
    MotionNoise,
    Planar,
    Rigid,
    RigidNoise,
    RigidState,
    Transition,
    planar_belief,
)

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
    belief = planar_belief(f32(START), jnp.zeros((3, 3)))
    predicted = EXECUTION.predict(belief, f32(u), DT)
    errors = body_frame_errors(np.asarray(predicted.mean, float), samples)
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
    belief = planar_belief(f32(START), f32(root @ root.T))
    predicted = EXECUTION.predict(belief, f32(u), DT)
    errors = body_frame_errors(np.asarray(predicted.mean, float), samples)
    assert_covariances_agree(np.asarray(predicted.covariance, float), errors)


@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_agrees_with_the_environments_robot(command: tuple[float, float, float]) -> None:
    u, rng = np.array(command), np.random.default_rng(3)
    samples = np.stack([execute(START, u, NOISE, rng) for _ in range(6000)])
    belief = planar_belief(f32(START), jnp.zeros((3, 3)))
    predicted = EXECUTION.predict(belief, f32(u), DT)
    errors = body_frame_errors(np.asarray(predicted.mean, float), samples)
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
    stood = planar_predict(planar_belief(f32(START), covariance), jnp.zeros(3), MotionNoise(0.5, 0.5))
    np.testing.assert_allclose(np.asarray(stood.planar), START, atol=1e-6)
    np.testing.assert_allclose(np.asarray(stood.covariance), np.asarray(covariance), atol=1e-7)


@given(planars, commands, st.integers(0, 2**32 - 1))
def test_covariances_stay_symmetric_and_positive(planar: np.ndarray, command: np.ndarray, seed: int) -> None:
    root = np.random.default_rng(seed).normal(scale=0.05, size=(3, 3))
    belief = planar_belief(f32(planar), f32(root @ root.T))
    covariance = np.asarray(planar_predict(belief, f32(command), MotionNoise(0.05, 0.02)).covariance, float)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-7)
    assert np.linalg.eigvalsh(covariance).min() > -1e-7


def test_means_take_batches() -> None:
    planar, control = jnp.ones((4, 5, 3)), jnp.full((4, 5, 3), 0.1)
    batch = planar_mean(planar, control)
    np.testing.assert_allclose(
        np.asarray(batch), np.asarray(jnp.broadcast_to(planar_mean(planar[0, 0], control[0, 0]), (4, 5, 3)))
    )


# --- laws of every transition: what the model is told about its steps


def _rigid(seed: int) -> RigidState:
    rng = np.random.default_rng(seed)
    return RigidState(se3_exp(f32(rng.normal(size=6))), f32(rng.normal(size=6)))


# A transition, one state, one control; noise wide enough that the curvature of rotations shows
LOOSE = RigidNoise(0.5, 0.3, 0.5, 0.6)
EVERY = {
    "rigid": (Rigid(LOOSE), _rigid(1), f32([0.5, 0.2, -0.1, 1.0, -0.4, 0.3])),
    "rigid, pose first": (Rigid(LOOSE, 0.2, velocity_first=False), _rigid(2), f32([0.5, 0.2, -0.1, 1.0, -0.4, 0.3])),
    "imu": (Imu(ImuNoise(0.1, 0.6, 0.2, 0.3)), _rigid(3), f32([0.3, 0.1, 9.5, 0.5, -1.0, 0.2])),
    "planar": (Planar(MotionNoise(0.02, 0.004), (0.01, 0.01, 0.02)), f32([0.4, -0.7, 2.9]), f32([0.15, 0.05, 0.12])),
    "bicycle": (Bicycle(), f32([0.4, -0.7, 2.9]), f32([1.0, 0.3])),
}
each = pytest.mark.parametrize("name", EVERY)


def several(state: object, n: int) -> object:
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *a.shape)), state)


def dimensions(transition: Transition, state: object) -> int:
    return transition.error(state, state).shape[-1]


@each
def test_errors_and_perturbations_are_inverse(name: str) -> None:
    transition, state, _ = EVERY[name]
    assert isinstance(transition, Transition)
    xi = np.random.default_rng(0).normal(size=(50, dimensions(transition, state))) * 0.5
    again = transition.error(state, transition.perturb(state, f32(xi)))
    np.testing.assert_allclose(np.asarray(again), xi, atol=2e-5)


@each
def test_volumes_are_determinants(name: str) -> None:
    """``log |det|`` of what an error moves, by forward differentiation at errors of half a radian."""
    transition, state, _ = EVERY[name]
    n = dimensions(transition, state)
    for seed in range(4):
        xi = f32(np.random.default_rng(seed).normal(size=n) * 0.5)
        there = transition.perturb(state, xi)
        moved = jax.jacfwd(lambda d, there=there, xi=xi: transition.error(there, transition.perturb(state, xi + d)))
        _, expected = np.linalg.slogdet(np.asarray(moved(jnp.zeros(n)), float))
        np.testing.assert_allclose(float(transition.log_volume(xi)), expected, atol=1e-3)


@each
def test_densities_belong_to_their_samples(name: str) -> None:
    """``E_p[q / p] = 1`` for a Gaussian ``q`` centred elsewhere: constants and volumes count."""
    transition, state, control = EVERY[name]
    sample, log_prob, error = (eqx.filter_jit(f) for f in (transition.sample, transition.log_prob, transition.error))
    n, dims = 20_000, dimensions(transition, state)
    drawn = sample(jax.random.key(0), several(state, n), several(control, n))
    log_p = np.asarray(log_prob(drawn, several(state, n), several(control, n)), float)
    xi = np.asarray(error(jax.tree.map(lambda a: a[0], drawn), drawn), float)
    # q: narrower than p so that the ratio is bounded, about a point within p
    mean = jax.tree.map(lambda a: a[0], drawn)
    for _ in range(5):
        mean = transition.perturb(mean, error(mean, drawn).mean(axis=0))
    centre = transition.perturb(mean, f32(0.3 * xi.std(axis=0)))
    xi = np.asarray(error(centre, drawn), float)
    covariance = 0.5 * np.cov(xi.T)
    log_q = stats.multivariate_normal.logpdf(xi, np.zeros(dims), covariance) - np.asarray(
        transition.log_volume(f32(xi))
    )
    ratio = np.exp(log_q - log_p)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(n) + 0.03
    assert ratio.std() < 8.0


@each
def test_samples_are_independent_and_batched(name: str) -> None:
    transition, state, control = EVERY[name]
    sample, log_prob = (eqx.filter_jit(f) for f in (transition.sample, transition.log_prob))
    drawn = sample(jax.random.key(1), several(several(state, 3), 2), several(several(control, 3), 2))
    poses = np.asarray(transition.pose(drawn))
    assert poses.shape == (2, 3, 4, 4)
    assert len(np.unique(poses.reshape(6, 16).round(6), axis=0)) == 6
    log_p = np.asarray(log_prob(drawn, several(several(state, 3), 2), several(several(control, 3), 2)))
    assert log_p.shape == (2, 3)
    one = jax.tree.map(lambda a: a[1, 2], drawn)
    np.testing.assert_allclose(log_p[1, 2], float(log_prob(one, state, control)), rtol=1e-4)


def test_the_planar_sample_never_reverses_a_motion() -> None:
    """Noise far larger than the command: turns keep their sign, steps are not negative, rest stays rest (SPEC 6)."""
    transition, n = Planar(MotionNoise(1.0, 1.0), (0.0, 0.0, 0.0)), 2000
    start = jnp.zeros((n, 3))
    moved = np.asarray(transition.sample(jax.random.key(0), start, jnp.broadcast_to(f32([0.1, 0.0, 0.0]), (n, 3))))
    np.testing.assert_array_equal(moved[:, :2], 0.0)
    assert moved[:, 2].min() >= -np.pi
    assert 0.4 < np.mean(moved[:, 2] == 0.0) < 0.5
    still = np.asarray(transition.sample(jax.random.key(0), start, jnp.zeros((n, 3))))
    np.testing.assert_allclose(still, 0.0, atol=1e-7)
    driven = np.asarray(transition.sample(jax.random.key(0), start, jnp.broadcast_to(f32([0.0, 0.0, 0.1]), (n, 3))))
    assert 0.4 < np.mean(np.abs(driven[:, :2]).max(axis=1) < 1e-6) < 0.5
