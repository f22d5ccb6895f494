"""Test the forms of actions: their spaces, their commands, and what they refuse."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.conventions.actions import Actions, from_unit
from vssm_gym.envs.robots.drive_response import WORN
from vssm_gym.envs.robots.registry import ROBOTS
from vssm_gym.errors import InputError

LOW, HIGH = np.array([-0.2, 0.0]), np.array([0.2, 0.16])
MOVES = (np.array([0.0, 0.16]), np.array([0.1, 0.0]))


def actions(form: str, stop: bool) -> Actions:
    return Actions(form, ("turn", "s"), (LOW, HIGH), MOVES, stop)


@pytest.mark.parametrize("stop", [False, True])
def test_spaces(stop):
    metric = actions("metric", stop).space
    assert metric.low.tolist() == np.array([*LOW, *[0.0] * stop], np.float32).tolist()
    assert metric.high.tolist() == np.array([*HIGH, *[1.0] * stop], np.float32).tolist()
    assert actions("normalized", stop).space == spaces.Box(-1.0, 1.0, (2 + stop,), np.float32)
    assert actions("discrete", stop).space == spaces.Discrete(2 + stop)


def test_normalised_actions_by_hand():
    """The ends are the robot's limits, 0 is their middle, and values beyond are clipped."""
    parse = actions("normalized", stop=False).parse
    for action, command in (([-1, -1], LOW), ([1, 1], HIGH), ([0, 0], [0.0, 0.08]), ([-7, 0.5], [-0.2, 0.12])):
        np.testing.assert_allclose(parse(action)[0], command, atol=1e-12)


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=2))
def test_normalised_and_metric_actions_are_the_same_commands(unit):
    metric = from_unit(np.array(unit), LOW, HIGH)
    np.testing.assert_allclose(actions("normalized", False).parse(unit)[0], actions("metric", False).parse(metric)[0])


def test_a_stop_is_above_the_middle_of_its_range_or_the_last_move():
    metric, unit, moves = (actions(form, stop=True).parse for form in ("metric", "normalized", "discrete"))
    assert [metric([0, 0, stop])[1] for stop in (0.0, 0.5, 0.51, 1.0)] == [False, False, True, True]
    assert [unit([0, 0, stop])[1] for stop in (-1.0, 0.0, 0.01, 1.0)] == [False, False, True, True]
    assert [moves(number)[1] for number in range(3)] == [False, False, True]
    np.testing.assert_array_equal(moves(2)[0], 0.0)


def test_discrete_actions_are_the_moves_and_cannot_be_changed_by_their_user():
    one = actions("discrete", stop=False)
    for number, move in enumerate(MOVES):
        command, stop = one.parse(np.int64(number))
        np.testing.assert_array_equal(command, move)
        assert not stop
        command += 1.0
        np.testing.assert_array_equal(one.parse(number)[0], move)


@pytest.mark.parametrize("action", [-1, 2, 0.0, np.nan, [0], None, "left", True])
def test_bad_moves_are_refused(action):
    with pytest.raises(InputError, match="action: expected a whole number from 0 to 1"):
        actions("discrete", stop=False).parse(action)


@pytest.mark.parametrize("action", [[0.0], [0.0, np.nan], [0.0, 0.0, 0.0], "ahead", None])
def test_bad_numbers_are_refused(action):
    for form in ("metric", "normalized"):
        with pytest.raises(InputError, match="step: action"):
            actions(form, stop=False).parse(action)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_moves_of_every_robot(name):
    """Without noise: 16 cm ahead, 11.5 degrees left and right on the spot, all of them within the limits.

    A worn drive that carries them out pulls to one side on the way.
    """
    robot = ROBOTS[name]()
    pull = 0.16 * WORN.pull if name == "worn" else 0.0
    low, high = robot.bounds
    turn = np.radians(11.5)
    for move, expected in zip(robot.moves, ([0.16, 0, pull], [0, 0, turn], [0, 0, -turn]), strict=True):
        assert (low <= move).all() and (move <= high).all()
        pose = robot.execute(np.zeros(3), move, robot.parse_noise("none"), np.random.default_rng(0))
        np.testing.assert_allclose(pose, expected, atol=1e-12)
