"""Test the noise with a mean: the simulator's law against the model's, its moments, and the published numbers."""

import math
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.robots import HOLONOMIC_NOISES, BiasedExecutionNoise, HolonomicRobot
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, matrix_to_planar, planar_to_matrix, wrap_angle
from vssm_gym.model.transition import BiasedNoise, Planar, planar_belief

LOCOBOT = HOLONOMIC_NOISES["locobot"]
SAMPLES = 40_000
STEP, TURN = HolonomicRobot.max_step, HolonomicRobot.max_turn
# of the robot's limits and far below them: driving, turning left and right, both, and neither
COMMANDS = [
    (0.0, 0.0, STEP),
    (0.0, 0.05, 0.02),
    (TURN, 0.0, 0.0),
    (-TURN, 0.0, 0.0),
    (-0.01, 0.0, 0.0),
    (TURN, 0.08, STEP),
    (-TURN, -0.08, 0.1),
    (0.0, 0.0, 0.0),
]
START = np.array([0.4, -0.7, 2.9])

errors = st.tuples(*[st.floats(-0.2, 0.2)] * 3)
stds = st.tuples(*[st.floats(0.0, 0.2)] * 3)
noises = st.builds(BiasedExecutionNoise, errors, stds, errors, stds, st.floats(0.05, 0.5), st.floats(0.1, 1.0))
planars = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-math.pi, math.pi)).map(np.array)
turns = st.one_of(st.just(0.0), st.floats(-TURN, TURN, allow_subnormal=False))
steps = st.one_of(st.just(0.0), st.floats(0.0, STEP, allow_subnormal=False))
commands = st.tuples(turns, st.floats(-3.0, 3.0), steps).map(np.array)
seeds = st.integers(0, 2**32 - 1)
frames = st.sampled_from(["body", "world"])


def transition(noise: BiasedExecutionNoise, frame: str = "body") -> Planar:
    return Planar(BiasedNoise(**asdict(noise)), (0.0, 0.0, 0.0), frame)


@given(planars, commands, noises, seeds, frames)
def test_the_simulator_equals_the_model(planar, command, noise, seed, frame):
    twin = HolonomicRobot(direction_frame=frame).execute(planar, command, noise, np.random.default_rng(seed))
    normal = np.random.default_rng(seed).standard_normal(4)
    with jax.enable_x64(True):
        law = transition(noise, frame).executed(*map(jnp.asarray, (planar, command, normal)))
    np.testing.assert_allclose(np.asarray(law)[:2], twin[:2], atol=1e-12)
    assert abs(np.exp(1j * float(law[2])) - np.exp(1j * twin[2])) < 1e-12


@given(planars, noises, seeds)
def test_a_robot_at_rest_stays_and_every_step_draws_the_same_amount(planar, noise, seed):
    one, other = np.random.default_rng(seed), np.random.default_rng(seed)
    np.testing.assert_allclose(noise.execute(planar, np.zeros(3), one)[:2], planar[:2], atol=0.0)
    noise.execute(planar, np.array([TURN, 0.0, STEP]), other)
    assert one.standard_normal() == other.standard_normal()


@given(commands, noises, seeds)
def test_no_error_of_a_motion_reverses_it(command, noise, seed):
    """A drive does not go backwards; a turn on the spot does not turn the other way."""
    turn, direction, step = command
    after = noise.execute(np.zeros(3), command, np.random.default_rng(seed))
    if step > 0.0:
        assert after[:2] @ [math.cos(direction), math.sin(direction)] >= -1e-12
    elif abs(after[2]) < 3.0:
        assert after[2] * turn >= 0.0


@pytest.mark.parametrize("frame", ["body", "world"])
@pytest.mark.parametrize("command", COMMANDS)
def test_prediction_agrees_with_samples(command, frame):
    """Mean and covariance in closed form, also where the motion is shorter than its errors and is stopped at 0."""
    model, u = transition(LOCOBOT, frame), jnp.asarray(command, jnp.float32)
    normal = jnp.asarray(np.random.default_rng(1).standard_normal((SAMPLES, 4)), jnp.float32)
    start = jnp.asarray(START, jnp.float32)
    samples = np.asarray(model.executed(jnp.tile(start, (SAMPLES, 1)), jnp.tile(u, (SAMPLES, 1)), normal), float)
    predicted = model.predict(planar_belief(start, jnp.zeros((3, 3))), u, 0.2)
    mean, covariance = np.asarray(predicted.mean, float), np.asarray(predicted.covariance, float)
    xi = matrix_to_planar(inverse(planar_to_matrix(mean)) @ planar_to_matrix(samples))
    assert (np.abs(xi.mean(axis=0)) <= 4.5 * xi.std(axis=0) / SAMPLES**0.5 + 5e-6).all()
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-10))
    scale = np.outer(spread, spread)
    np.testing.assert_allclose(np.cov(xi.T) / scale, covariance / scale, atol=0.04)


@given(st.floats(0.05, 0.95), noises)
def test_the_errors_of_two_parts_add_up_to_those_of_the_whole(part, noise):
    """Mean and variance of a motion are the sums of those of its parts."""
    means, stds = zip(*(noise._errors(share, 0.5 * share) for share in (1.0, part, 1.0 - part)), strict=True)
    np.testing.assert_allclose(means[1] + means[2], means[0], atol=1e-12)
    np.testing.assert_allclose(stds[1] ** 2 + stds[2] ** 2, stds[0] ** 2, atol=1e-12)


def test_locobot_is_what_habitat_samples():
    """Half of the published means; the square roots of the published spreads. Its right is our negative left."""
    assert (LOCOBOT.drive_length, LOCOBOT.turn_angle) == (0.25, math.radians(30.0))
    np.testing.assert_allclose(LOCOBOT.drive_mean, [0.0085, -0.021, 0.0155])
    np.testing.assert_allclose(np.square(LOCOBOT.drive_std), np.array([0.007, 0.023, 0.026]) / 4)
    np.testing.assert_allclose(LOCOBOT.turn_mean, [0.0005, -0.0025, 0.0215])
    np.testing.assert_allclose(np.square(LOCOBOT.turn_std), np.array([0.001, 0.004, 0.017]) / 4)
    rng, long = np.random.default_rng(0), np.array([0.0, 0.0, 0.25])
    ends = np.array([LOCOBOT.execute(np.zeros(3), long, rng) for _ in range(10_000)])
    np.testing.assert_allclose(ends.mean(axis=0), [0.2585, -0.021, 0.0155], atol=0.004)
    np.testing.assert_allclose(ends.std(axis=0), LOCOBOT.drive_std, rtol=0.03)
    right = np.array([LOCOBOT.execute(np.zeros(3), np.array([-math.radians(30.0), 0, 0]), rng) for _ in range(10_000)])
    assert abs(float(wrap_angle(right[:, 2].mean() + math.radians(30.0) + 0.0215))) < 0.004  # it overshoots


def test_planners_keep_clear_of_a_longest_step():
    turn, step = LOCOBOT.deviations(STEP)
    rng = np.random.default_rng(2)
    ends = np.array([LOCOBOT.execute(np.zeros(3), np.array([0, 0, STEP]), rng) for _ in range(10_000)])
    off = ends[:, :2] - [STEP, 0.0]
    np.testing.assert_allclose([STEP * math.tan(turn), step], np.sqrt((off**2).mean(axis=0))[::-1], rtol=0.03)


@pytest.mark.parametrize("field", ["drive_std", "turn_std", "drive_mean", "drive_length", "turn_angle"])
def test_bad_numbers_are_named(field):
    bad = 0.0 if field in ("drive_length", "turn_angle") else (0.1, math.nan, 0.1)
    with pytest.raises(InputError, match=field):
        replace(LOCOBOT, **{field: bad})
