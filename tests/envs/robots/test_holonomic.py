"""Test the laws of the holonomic robot's noisy kinematics."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.envs.robots import NOISE_LEVELS, ExecutionNoise, HolonomicRobot, execute, execution_noise
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition import MotionNoise, Planar

ROBOT = HolonomicRobot()
NONE = NOISE_LEVELS["none"]

planars = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-math.pi, math.pi)).map(np.array)
turns = st.one_of(st.just(0.0), st.floats(-ROBOT.max_turn, ROBOT.max_turn))
steps = st.one_of(st.just(0.0), st.floats(0.0, ROBOT.max_step))
commands = st.tuples(turns, st.floats(-ROBOT.max_offset, ROBOT.max_offset), steps).map(np.array)
noises = st.builds(ExecutionNoise, st.floats(0.0, 0.3), st.floats(0.0, 0.2))
seeds = st.integers(0, 2**32 - 1)


@given(planars, commands)
def test_without_noise_the_command_is_executed_exactly(planar, command):
    after = execute(planar, command, NONE, np.random.default_rng(0))
    turn, offset, step = command
    phi = planar[2] + offset
    np.testing.assert_allclose(after[:2], planar[:2] + step * np.array([math.cos(phi), math.sin(phi)]), atol=1e-12)
    assert abs(wrap_angle(np.array(after[2] - planar[2] - turn))) < 1e-12
    assert -math.pi <= after[2] < math.pi


@given(planars, commands, noises, seeds)
def test_noise_never_reverses_a_motion_and_never_moves_a_robot_at_rest(planar, command, noise, seed):
    after = execute(planar, command, noise, np.random.default_rng(seed))
    turn, offset, step = command
    turned = float(wrap_angle(np.array(after[2] - planar[2])))
    moved = after[:2] - planar[:2]
    if turn == 0.0:
        assert abs(turned) < 1e-12
    elif abs(turned) > 1e-12 and abs(turned) < 3.0:  # a turn past pi would wrap
        assert math.copysign(1.0, turned) == math.copysign(1.0, turn)
    if step == 0.0:
        np.testing.assert_array_equal(moved, 0.0)
    elif np.linalg.norm(moved) > 1e-9:
        # The direction strays from heading + offset by e_a, which the same seed gives again.
        e_a = np.random.default_rng(seed).standard_normal(2)[0] * noise.turn
        direction = math.atan2(moved[1], moved[0])
        assert abs(wrap_angle(np.array(direction - planar[2] - offset - e_a))) < 1e-5


@given(planars, commands, seeds)
def test_the_same_error_turns_the_body_and_its_path(planar, command, seed):
    noise = ExecutionNoise(turn=0.02, step=0.0)
    turn, offset, step = abs(command[0]) + 0.1, command[1], command[2] + 0.01
    after = execute(planar, np.array([turn, offset, step]), noise, np.random.default_rng(seed))
    e_turn = float(wrap_angle(np.array(after[2] - planar[2] - turn)))
    way = math.atan2(after[1] - planar[1], after[0] - planar[0])
    assert abs(float(wrap_angle(np.array(way - planar[2] - offset - e_turn)))) < 1e-6


def test_a_run_that_shares_the_seed_shares_the_noise_of_each_step():
    noise, moves = NOISE_LEVELS["high"], np.array([0.1, 0.0, 0.1])
    one, other = np.random.default_rng(7), np.random.default_rng(7)
    execute(np.zeros(3), np.zeros(3), noise, one)  # one robot rests in the first step, the other drives
    execute(np.zeros(3), moves, noise, other)
    a, b = execute(np.zeros(3), moves, noise, one), execute(np.zeros(3), moves, noise, other)
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("level", ["low", "mid", "high"])
def test_errors_follow_the_truncated_gaussian(level):
    noise, rng = NOISE_LEVELS[level], np.random.default_rng(3)
    turn, step = math.radians(6.0), 0.05
    ends = np.array([execute(np.zeros(3), np.array([turn, 0.0, step]), noise, rng) for _ in range(4000)])
    moved = np.linalg.norm(ends[:, :2], axis=1)
    for samples, mean, std in ((ends[:, 2], turn, noise.turn), (moved, step, noise.step)):
        # max(0, N(mean, std)): an atom at 0 of probability Phi(-mean / std), a Gaussian above it.
        atom = stats.norm.cdf(0.0, mean, std)
        at_zero = np.mean(samples < 1e-9)
        assert abs(at_zero - atom) < 4.0 * math.sqrt(atom * (1 - atom) / len(samples)) + 1e-3
        positive = samples[samples >= 1e-9]
        cdf = lambda x, mean=mean, std=std, atom=atom: (stats.norm.cdf(x, mean, std) - atom) / (1.0 - atom)
        assert stats.kstest(positive, cdf).pvalue > 1e-3


def test_published_levels():
    degrees = {"none": 0.0, "low": 3.0, "mid": 6.0, "high": 9.0}
    share = {"none": 0.0, "low": 0.10, "mid": 0.15, "high": 0.30}
    for name, noise in NOISE_LEVELS.items():
        assert noise.turn == pytest.approx(math.radians(degrees[name]))
        assert noise.step == pytest.approx(share[name] * ROBOT.body_length)
    assert ROBOT.max_step == pytest.approx(0.8 * ROBOT.body_length)


def test_the_camera_faces_along_body_x_at_its_height():
    T = ROBOT.T_body_cam
    point_cam = np.array([0.3, -0.2, 2.0, 1.0])  # right, up, ahead
    np.testing.assert_allclose((T @ point_cam)[:3], [2.0, -0.3, ROBOT.camera_height + 0.2])


WORLD = HolonomicRobot(direction_frame="world")


@given(planars, turns, st.floats(-math.pi, math.pi), steps, noises, seeds)
def test_a_direction_in_the_world_does_not_depend_on_the_heading(planar, turn, direction, step, noise, seed):
    command, other = np.array([turn, direction, step]), planar + np.array([0.0, 0.0, 1.3])
    a, b = (WORLD.execute(start, command, noise, np.random.default_rng(seed)) for start in (planar, other))
    np.testing.assert_allclose(a[:2], b[:2], atol=1e-12)
    assert abs(float(wrap_angle(np.array(b[2] - a[2] - 1.3)))) < 1e-12
    relative = np.array([turn, direction - planar[2], step])
    np.testing.assert_allclose(ROBOT.execute(planar, relative, noise, np.random.default_rng(seed)), a, atol=1e-12)


def test_the_robot_with_a_compass_drives_anywhere():
    np.testing.assert_array_equal(WORLD.bounds[1], [ROBOT.max_turn, math.pi, ROBOT.max_step])
    north = WORLD.execute(np.zeros(3), np.array([0.0, math.pi / 2, 0.1]), NONE, np.random.default_rng(0))
    np.testing.assert_allclose(north, [0.0, 0.1, 0.0], atol=1e-12)
    with pytest.raises(InputError, match="direction_frame: expected one of 'body', 'world'; found 'map'"):
        HolonomicRobot(direction_frame="map")


@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_clip_is_the_nearest_allowed_command(command):
    clipped = ROBOT.clip(np.array(command))
    assert (np.abs(clipped) <= ROBOT.limits).all() and clipped[2] >= 0.0
    np.testing.assert_array_equal(ROBOT.clip(clipped), clipped)


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_bad_noise_is_named(bad):
    with pytest.raises(InputError, match="turn"):
        ExecutionNoise(turn=bad, step=0.0)
    with pytest.raises(InputError, match="low, mid, high"):
        execution_noise("loud")


whole = {"allow_subnormal": False}  # XLA flushes smaller numbers to zero, and then nothing is commanded
any_turn = st.one_of(st.just(0.0), st.floats(-ROBOT.max_turn, ROBOT.max_turn, **whole))
any_step = st.one_of(st.just(0.0), st.floats(0.0, ROBOT.max_step, **whole))


@given(planars, any_turn, st.floats(-ROBOT.max_offset, ROBOT.max_offset), any_step, noises, seeds)
def test_it_equals_the_models_law(planar, turn, offset, step, noise, seed):
    """The same normals give the same pose in NumPy and in JAX, also where noise is rectified."""
    command = np.array([turn, offset, step])
    twin = execute(planar, command, noise, np.random.default_rng(seed))
    normal = np.random.default_rng(seed).standard_normal(2)
    with jax.enable_x64(True):
        law = Planar(MotionNoise(noise.turn, noise.step)).executed(*map(jnp.asarray, (planar, command, normal)))
    np.testing.assert_allclose(np.asarray(law)[:2], twin[:2], atol=1e-12)
    assert abs(np.exp(1j * float(law[2])) - np.exp(1j * twin[2])) < 1e-12
