"""Test the planar transition against simulation, and the laws of every transition and belief."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from tests.helpers.dynamics.transitions import random_planar, random_transition
from vssm_gym.envs.robots import NOISE_LEVELS, ExecutionNoise, execute
from vssm_gym.geometry.transforms import inverse, matrix_to_planar, planar_to_matrix, se3_exp
from vssm_gym.model.transition import (
    Belief,
    BiasedNoise,
    Bicycle,
    GaussianBelief,
    Imu,
    ImuNoise,
    Manifold,
    MotionNoise,
    Planar,
    Rigid,
    RigidNoise,
    RigidState,
    Transition,
    planar_belief,
)
from vssm_gym.model.transition.calibrated import CalibratedDrive, CalibratedImu, ImuConstants
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.model.transition.with_rest import RestState

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
DT = 0.1  # s
EXECUTION = Planar(MotionNoise(NOISE.turn, NOISE.step), slip=(0.0, 0.0, 0.0))
SLIP = (0.004, 0.003, 0.002)

commands = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.08, 0.08), st.floats(0.0, 0.16)).map(np.array)
planars = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.14, 3.14)).map(np.array)


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def body_frame_errors(mean: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return ``xi`` (n, 3) of ``T = T_mean exp(xi)``, to first order in the rotation."""
    return matrix_to_planar(inverse(planar_to_matrix(mean)) @ planar_to_matrix(samples))


def as_executed(planar: np.ndarray, command: np.ndarray, noise: ExecutionNoise, rng: np.random.Generator) -> np.ndarray:
    """Add execution noise to many robots (n, 3); a right turn flips its sign, a direction does not."""
    turn, offset, step = command
    e_a, e_s = rng.normal(0.0, noise.turn, len(planar)), rng.normal(0.0, noise.step, len(planar))
    turned = np.sign(turn) * np.maximum(0.0, abs(turn) + e_a)
    moved = np.maximum(0.0, step + e_s) if step > 0 else np.zeros(len(planar))
    phi = planar[:, 2] + offset + e_a
    return np.stack([planar[:, 0] + moved * np.cos(phi), planar[:, 1] + moved * np.sin(phi), planar[:, 2] + turned], 1)


def assert_covariances_agree(predicted: np.ndarray, errors: np.ndarray, tolerance: float = 0.04) -> None:
    """Compare covariances entry by entry, in units of the predicted standard deviations."""
    empirical = np.cov(errors.T)
    spread = np.sqrt(np.maximum(np.diag(predicted), 1e-10))
    np.testing.assert_allclose(
        empirical / np.outer(spread, spread), predicted / np.outer(spread, spread), atol=tolerance
    )


@pytest.mark.parametrize("noise", [NOISE, NOISE_LEVELS["high"]], ids=["small", "rectified"])
@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_from_a_known_pose_agrees_with_simulation(
    command: tuple[float, float, float], noise: ExecutionNoise
) -> None:
    """Both moments are right where noise is larger than the motion, which it never reverses."""
    u = np.array(command)
    samples = as_executed(np.tile(START, (SAMPLES, 1)), u, noise, np.random.default_rng(1))
    belief = planar_belief(f32(START), jnp.zeros((3, 3)))
    predicted = Planar(MotionNoise(noise.turn, noise.step), (0.0, 0.0, 0.0)).predict(belief, f32(u), DT)
    errors = body_frame_errors(np.asarray(predicted.mean, float), samples)
    assert (np.abs(errors.mean(axis=0)) <= 4.5 * errors.std(axis=0) / SAMPLES**0.5 + 2e-6).all()
    assert_covariances_agree(np.asarray(predicted.covariance, float), errors)


@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_of_a_belief_agrees_with_simulation(command: tuple[float, float, float]) -> None:
    """The belief before the step is correlated and wider than the noise of the step."""
    u, rng = np.array(command), np.random.default_rng(2)
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.01, 0.015, 0.02]])
    xi = rng.standard_normal((SAMPLES, 3)) @ root.T
    starts = matrix_to_planar(planar_to_matrix(START) @ planar_to_matrix(xi))
    samples = as_executed(starts, u, NOISE, rng)
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
    mean = np.asarray(EXECUTION.mean(f32(planar), f32(command), DT), float)
    np.testing.assert_allclose(mean[:2], expected[:2], atol=1e-5)
    assert abs(np.exp(1j * mean[2]) - np.exp(1j * expected[2])) < 1e-5
    assert -np.pi - 1e-6 <= mean[2] <= np.pi + 1e-6


def test_the_mean_by_hand() -> None:
    """At heading 0: drive 0.1 m at 30 degrees to the left, then face 0.2 rad."""
    mean = EXECUTION.mean(jnp.zeros(3), jnp.array([0.2, np.pi / 6, 0.1]), DT)
    np.testing.assert_allclose(np.asarray(mean), [0.1 * np.sqrt(3) / 2, 0.05, 0.2], rtol=1e-5)


def test_a_robot_that_does_not_move_stays_as_certain() -> None:
    covariance = f32(np.diag([0.01, 0.02, 0.03]))
    belief = planar_belief(f32(START), covariance)
    stood = Planar(MotionNoise(0.5, 0.5), (0.0, 0.0, 0.0)).predict(belief, jnp.zeros(3), DT)
    np.testing.assert_allclose(np.asarray(stood.mean), START, atol=1e-6)
    np.testing.assert_allclose(np.asarray(stood.covariance), np.asarray(covariance), atol=1e-7)
    slipped = Planar(MotionNoise(0.5, 0.5), SLIP).predict(belief, jnp.zeros(3), DT)
    expected = np.asarray(covariance) + np.diag(np.square(SLIP))
    np.testing.assert_allclose(np.asarray(slipped.covariance), expected, atol=1e-7)


@given(planars, commands)
def test_slip_adds_to_the_noise_of_the_execution(planar: np.ndarray, command: np.ndarray) -> None:
    belief = planar_belief(f32(planar), f32(np.diag([0.01, 0.02, 0.03])))
    slips = Planar(EXECUTION.noise, SLIP).predict(belief, f32(command), DT)
    expected = np.asarray(EXECUTION.predict(belief, f32(command), DT).covariance) + np.diag(np.square(SLIP))
    np.testing.assert_allclose(np.asarray(slips.covariance), expected, atol=1e-7)


@given(planars, commands, st.integers(0, 2**32 - 1))
def test_covariances_stay_symmetric_and_positive(planar: np.ndarray, command: np.ndarray, seed: int) -> None:
    root = np.random.default_rng(seed).normal(scale=0.05, size=(3, 3))
    belief = planar_belief(f32(planar), f32(root @ root.T))
    robot = Planar(MotionNoise(0.05, 0.02), (0.0, 0.0, 0.0))
    covariance = np.asarray(robot.predict(belief, f32(command), DT).covariance, float)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-7)
    assert np.linalg.eigvalsh(covariance).min() > -1e-7


def test_means_take_batches() -> None:
    planar, control = jnp.ones((4, 5, 3)), jnp.full((4, 5, 3), 0.1)
    batch = EXECUTION.mean(planar, control, DT)
    one = EXECUTION.mean(planar[0, 0], control[0, 0], DT)
    np.testing.assert_allclose(np.asarray(batch), np.asarray(jnp.broadcast_to(one, (4, 5, 3))))


# --- laws of every transition


class Case(NamedTuple):
    """Hold a transition, a state, a control and a step; the noise is wide, so that curvature matters."""

    transition: Transition
    state: Any
    control: jax.Array
    dt: float = DT


def _rigid(seed: int) -> RigidState:
    rng = np.random.default_rng(seed)
    return RigidState(se3_exp(f32(rng.normal(size=6))), f32(rng.normal(size=6)))


LOOSE = RigidNoise(0.5, 0.3, 0.5, 0.6)
PUSH = f32([0.5, 0.2, -0.1, 1.0, -0.4, 0.3])
BIASED = BiasedNoise((0.01, -0.03, 0.02), (0.02, 0.03, 0.04), (0.01, 0.02, 0.03), (0.02, 0.01, 0.05), 0.25, 0.5)
EVERY = {
    "rigid": Case(Rigid(LOOSE), _rigid(1), PUSH),
    "rigid, pose first": Case(Rigid(LOOSE, velocity_first=False), _rigid(2), PUSH, 0.2),
    "imu": Case(Imu(ImuNoise(0.1, 0.6, 0.2, 0.3)), _rigid(3), f32([0.3, 0.1, 9.5, 0.5, -1.0, 0.2])),
    "planar": Case(Planar(MotionNoise(0.02, 0.004), (0.01, 0.01, 0.02)), f32(START), f32([0.15, 0.05, 0.12])),
    "planar, world": Case(
        Planar(MotionNoise(0.02, 0.004), (0.01, 0.01, 0.02), "world"), f32(START), f32([0.15, 0.7, 0.12])
    ),
    "planar, biased": Case(Planar(BIASED, (0.01, 0.01, 0.02)), f32(START), f32([0.15, 0.05, 0.12])),
    "planar, biased turn": Case(Planar(BIASED, (0.01, 0.01, 0.02), "world"), f32(START), f32([0.15, 0.3, 0.0])),
    "bicycle": Case(Bicycle(), f32(START), f32([1.0, 0.3])),
    "learned, imu": Case(
        random_transition(spread=0.1), RestState(_rigid(4), f32([0.3, -0.2])), f32([0.3, 0.1, 9.5, 0.5, -1.0, 0.2])
    ),
    "odometry": Case(Odometry((0.02, 0.01, 0.03)), f32(START), f32([0.2, -0.05, 0.3])),
    "learned, planar": Case(random_planar(), RestState(f32(START), f32([0.3, -0.2])), f32([0.15, 0.05, 0.12])),
    "calibrated imu": Case(
        CalibratedImu(ImuConstants(*f32(np.full((4, 3), 0.1))), Imu(ImuNoise(0.1, 0.6, 0.2, 0.3))),
        _rigid(5),
        f32([0.3, 0.1, 9.5, 0.5, -1.0, 0.2]),
    ),
    "calibrated drive": Case(
        CalibratedDrive(Bicycle(), f32([[0.9, 0.0], [0.1, 1.1]]), f32([0.0, 0.02])), f32(START), f32([1.0, 0.3])
    ),
}
each = pytest.mark.parametrize("name", EVERY)


def several(state: Any, n: int) -> Any:
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *a.shape)), state)


def dimensions(transition: Transition) -> int:
    return len(transition.manifold.turns)


def some_covariance(n: int, seed: int = 0, scale: float = 0.05) -> np.ndarray:
    """Return a correlated, positive definite covariance."""
    root = np.random.default_rng(seed).normal(size=(n, n)) * scale / np.sqrt(n)
    return root @ root.T + (0.3 * scale) ** 2 * np.eye(n)


def same(actual: np.ndarray, expected: np.ndarray, turns: np.ndarray | None = None, atol: float = 1e-5) -> None:
    """Compare states entry by entry, headings modulo a whole turn."""
    off = np.asarray(actual, float) - np.asarray(expected, float)
    if turns is not None:
        off[..., turns] = np.angle(np.exp(1j * off[..., turns]))
    np.testing.assert_allclose(off, 0.0, atol=atol)


def assert_density_belongs(manifold: Manifold, drawn: Any, log_prob: Callable[[Any], jax.Array]) -> None:
    """Assert ``E_p[q / p] = 1`` for a Gaussian ``q`` centred elsewhere, which tests constants and volumes."""
    error = eqx.filter_jit(manifold.error)
    log_p = np.asarray(log_prob(drawn), float)
    xi = np.asarray(error(jax.tree.map(lambda a: a[0], drawn), drawn), float)
    # q: narrower than p so that the ratio is bounded, about a point within p
    mean = jax.tree.map(lambda a: a[0], drawn)
    for _ in range(5):
        mean = manifold.perturb(mean, error(mean, drawn).mean(axis=0))
    centre = manifold.perturb(mean, f32(0.3 * xi.std(axis=0)))
    xi = np.asarray(error(centre, drawn), float)
    covariance = 0.5 * np.cov(xi.T)
    log_q = stats.multivariate_normal.logpdf(xi, np.zeros(xi.shape[1]), covariance)
    ratio = np.exp(log_q - np.asarray(manifold.log_volume(f32(xi))) - log_p)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(xi)) + 0.03
    assert ratio.std() < 8.0


@each
def test_errors_and_perturbations_are_inverse(name: str) -> None:
    transition, state, *_ = EVERY[name]
    assert isinstance(transition, Transition)
    assert isinstance(transition.manifold, Manifold)
    xi = np.random.default_rng(0).normal(size=(50, dimensions(transition))) * 0.5
    again = transition.manifold.error(state, transition.manifold.perturb(state, f32(xi)))
    np.testing.assert_allclose(np.asarray(again), xi, atol=2e-5)


@each
def test_volumes_are_determinants(name: str) -> None:
    """``log |det|`` of what an error moves, by forward differentiation at errors of half a radian."""
    transition, state, *_ = EVERY[name]
    manifold, n = transition.manifold, dimensions(transition)
    for seed in range(4):
        xi = f32(np.random.default_rng(seed).normal(size=n) * 0.5)
        there = manifold.perturb(state, xi)
        moved = jax.jacfwd(lambda d, there=there, xi=xi: manifold.error(there, manifold.perturb(state, xi + d)))
        _, expected = np.linalg.slogdet(np.asarray(moved(jnp.zeros(n)), float))
        np.testing.assert_allclose(float(manifold.log_volume(xi)), expected, atol=1e-3)


@each
def test_the_pose_comes_first_among_the_errors(name: str) -> None:
    """``T_world_body`` of ``perturb(z, xi)`` is ``T exp(twists xi_pose)``; a resting body has the pose it rests at."""
    transition, state, *_ = EVERY[name]
    manifold = transition.manifold
    p = manifold.twists.shape[1]
    xi = np.random.default_rng(1).normal(size=dimensions(transition)) * 0.3
    moved = manifold.pose(manifold.perturb(state, f32(xi)))
    expected = manifold.pose(state) @ se3_exp(f32(manifold.twists @ xi[:p]))
    np.testing.assert_allclose(np.asarray(moved), np.asarray(expected), atol=2e-6)
    at_rest = manifold.resting(manifold.pose(state))
    np.testing.assert_allclose(np.asarray(manifold.pose(at_rest)), np.asarray(manifold.pose(state)), atol=1e-6)
    assert jax.tree.structure(at_rest) == jax.tree.structure(state)


@each
def test_densities_belong_to_their_samples(name: str) -> None:
    transition, state, control, dt = EVERY[name]
    n = 20_000
    drawn = eqx.filter_jit(transition.sample)(jax.random.key(0), several(state, n), several(control, n), dt)
    log_prob = eqx.filter_jit(transition.log_prob)
    assert_density_belongs(
        transition.manifold, drawn, lambda drawn: log_prob(drawn, several(state, n), several(control, n), dt)
    )


@each
def test_default_densities_belong_to_default_samples(name: str) -> None:
    """A transition inherits densities from its mean and its noise."""
    transition, state, control, dt = EVERY[name]
    n = 20_000
    drawn = eqx.filter_jit(partial(Transition.sample, transition))(
        jax.random.key(0), several(state, n), several(control, n), dt
    )
    log_prob = eqx.filter_jit(partial(Transition.log_prob, transition))
    assert_density_belongs(
        transition.manifold, drawn, lambda drawn: log_prob(drawn, several(state, n), several(control, n), dt)
    )


@each
def test_samples_are_independent_and_batched(name: str) -> None:
    transition, state, control, dt = EVERY[name]
    for owner in (type(transition), Transition):
        sample, log_prob = (eqx.filter_jit(partial(f, transition)) for f in (owner.sample, owner.log_prob))
        states, controls = several(several(state, 3), 2), several(several(control, 3), 2)
        drawn = sample(jax.random.key(1), states, controls, dt)
        poses = np.asarray(transition.manifold.pose(drawn))
        assert poses.shape == (2, 3, 4, 4)
        assert len(np.unique(poses.reshape(6, 16).round(6), axis=0)) == 6
        log_p = np.asarray(log_prob(drawn, states, controls, dt))
        assert log_p.shape == (2, 3)
        one = jax.tree.map(lambda a: a[1, 2], drawn)
        np.testing.assert_allclose(log_p[1, 2], float(log_prob(one, state, control, dt)), rtol=1e-4)


@each
def test_the_default_jacobian_is_the_transitions_own(name: str) -> None:
    """Forward differentiation on the manifold is the oracle of every linearisation in closed form."""
    transition, state, control, dt = EVERY[name]
    expected = eqx.filter_jit(partial(Transition.jacobian, transition))(state, control, dt)
    np.testing.assert_allclose(
        np.asarray(transition.jacobian(state, control, dt)), np.asarray(expected), rtol=1e-4, atol=2e-5
    )


@each
def test_prediction_is_of_first_order(name: str) -> None:
    """``F P F^T + S Q S``, symmetric and positive; scale 0 leaves what is carried along."""
    transition, state, control, dt = EVERY[name]
    manifold, n = transition.manifold, dimensions(transition)
    P = some_covariance(n)
    F = np.asarray(transition.jacobian(state, control, dt), float)
    Q = np.asarray(transition.noise_covariance(state, control, dt), float)
    belief = GaussianBelief(state, f32(P), manifold)
    scales = {"none": 0.0, "all": 1.0, "each its own": f32(np.linspace(0.2, 3.0, n))}
    for label, scale in scales.items():
        predicted = transition.predict(belief, control, dt, scale)
        S = np.broadcast_to(np.asarray(scale, float), n)
        covariance = np.asarray(predicted.covariance, float)
        expected = F @ P @ F.T + S[:, None] * Q * S
        np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max(), err_msg=label)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > -1e-6 * np.abs(covariance).max()
        off = manifold.error(transition.expected(state, control, dt), predicted.mean)
        np.testing.assert_allclose(np.asarray(off), 0.0, atol=1e-6)
    known = transition.predict(GaussianBelief(state, jnp.zeros((n, n)), manifold), control, dt, 0.0)
    np.testing.assert_array_equal(np.asarray(known.covariance), 0.0)


@each
def test_paths_without_noise_are_repeated_means(name: str) -> None:
    transition, state, control, dt = EVERY[name]
    signs = np.array([1, 1, -1, 1, 0.5, 0.2, -0.4])
    controls = f32(signs[:, None] * np.asarray(control))
    by_hand = []
    for u in controls:
        by_hand.append(transition.mean(by_hand[-1] if by_hand else state, u, dt))
    expected = jax.tree.map(lambda *a: jnp.stack(a), *by_hand)
    turns = transition.manifold.turns if isinstance(state, jax.Array) else None
    for path in (transition.mean_path(state, controls, dt), Transition.mean_path(transition, state, controls, dt)):
        for actual, leaf in zip(jax.tree.leaves(path), jax.tree.leaves(expected), strict=True):
            same(actual, leaf, turns, atol=2e-5)


def test_paths_of_many_sequences_are_those_of_each() -> None:
    """This is tested on the bicycle, since planners evaluate hundreds of control sequences at once."""
    car, controls = Bicycle(), f32(np.random.default_rng(0).uniform([-1, -0.5], [1, 0.5], (5, 6, 2)))
    paths = car.mean_path(f32(START), controls, DT)
    for k in range(5):
        np.testing.assert_allclose(paths[k], car.mean_path(f32(START), controls[k], DT), atol=1e-6)


def test_the_planar_sample_never_reverses_a_motion() -> None:
    """With noise far larger than the command, turns keep their sign, steps are not negative, and rest stays rest."""
    transition, n = Planar(MotionNoise(1.0, 1.0), (0.0, 0.0, 0.0)), 2000
    start = jnp.zeros((n, 3))
    draw = lambda u: np.asarray(transition.sample(jax.random.key(0), start, jnp.broadcast_to(f32(u), (n, 3)), DT))
    moved = draw([0.1, 0.0, 0.0])
    np.testing.assert_array_equal(moved[:, :2], 0.0)
    assert moved[:, 2].min() >= -np.pi
    assert 0.4 < np.mean(moved[:, 2] == 0.0) < 0.5
    np.testing.assert_allclose(draw([0.0, 0.0, 0.0]), 0.0, atol=1e-7)
    driven = draw([0.0, 0.0, 0.1])
    assert 0.4 < np.mean(np.abs(driven[:, :2]).max(axis=1) < 1e-6) < 0.5


# --- laws of every belief


@each
def test_the_density_of_a_belief_belongs_to_its_samples(name: str) -> None:
    transition, state, *_ = EVERY[name]
    belief = GaussianBelief(state, f32(some_covariance(dimensions(transition), scale=0.3)), transition.manifold)
    assert isinstance(belief, Belief)
    drawn = belief.sample(jax.random.key(0), 20_000)
    assert_density_belongs(transition.manifold, drawn, eqx.filter_jit(belief.log_prob))


@each
def test_the_entropy_of_a_belief_is_its_mean_surprise(name: str) -> None:
    """``E[-log q(z)] = H(xi) + E[log |det Jr(xi)|]``, which includes the volume of the manifold."""
    transition, state, *_ = EVERY[name]
    manifold, n = transition.manifold, dimensions(transition)
    covariance = some_covariance(n, scale=0.3)
    belief = GaussianBelief(state, f32(covariance), manifold)
    exact = 0.5 * (n * np.log(2.0 * np.pi * np.e) + np.linalg.slogdet(covariance)[1])
    np.testing.assert_allclose(float(belief.entropy()), exact, atol=1e-3)
    drawn = belief.sample(jax.random.key(1), 20_000)
    surprise = -np.asarray(eqx.filter_jit(belief.log_prob)(drawn), float)
    xi = np.asarray(manifold.error(belief.mean, drawn), float)
    volume = np.asarray(manifold.log_volume(f32(xi)), float)
    assert abs(volume.mean()) > 3e-3  # so that a density without it would be noticed
    # The chi-square of the draws, whose mean is n, is taken apart: the rest has no Monte-Carlo error.
    distance2 = np.einsum("ki,ij,kj->k", xi, np.linalg.inv(covariance), xi)
    assert abs(distance2.mean() - n) < 4.0 * np.sqrt(2.0 * n / len(xi))
    assert abs(np.mean(surprise - 0.5 * (distance2 - n)) - exact - volume.mean()) < 1e-3


@each
def test_a_known_direction_is_sampled_at_the_mean(name: str) -> None:
    """Samples vary along two directions for rank 2, and not at all for rank 0, where the entropy is -inf."""
    transition, state, *_ = EVERY[name]
    manifold, n = transition.manifold, dimensions(transition)
    axes = np.linalg.qr(np.random.default_rng(2).normal(size=(n, n)))[0]
    covariance = axes[:, :2] @ np.diag([0.04, 0.01]) @ axes[:, :2].T
    belief = GaussianBelief(state, f32(covariance), manifold)
    xi = np.asarray(manifold.error(state, belief.sample(jax.random.key(2), 4000)), float) @ axes
    np.testing.assert_allclose(xi[:, 2:], 0.0, atol=5e-4)  # what float32 leaves of the zero eigenvalues' roots
    np.testing.assert_allclose(np.cov(xi[:, :2].T) / 0.04, np.diag([1.0, 0.25]), atol=0.08)
    known = GaussianBelief(state, jnp.zeros((n, n)), manifold)
    for actual, leaf in zip(jax.tree.leaves(known.sample(jax.random.key(3), 5)), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(np.asarray(actual), np.broadcast_to(leaf, actual.shape), atol=1e-6)
    assert float(known.entropy()) == -np.inf
