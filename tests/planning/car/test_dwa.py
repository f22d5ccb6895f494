"""Test the dynamic window: admissible commands, no collision, goals that it reaches, and one that it does not."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.car_worlds import CAR, DEAD_END, SEALED, collides, levels, move, occupied, solid
from vssm_gym.errors import InputError
from vssm_gym.planning.car.dwa import DwaConfig, DwaState, DwaStatus, DynamicWindow
from vssm_gym.planning.car.footprint_levels import COLLIDING

ROOM = occupied(4.0, 3.0)
COLUMN = occupied(4.0, 3.0, (1.8, 1.2, 2.2, 1.8))


def run(grid: np.ndarray, start: np.ndarray, goal: np.ndarray, steps: int = 600) -> tuple[np.ndarray, list[DwaState]]:
    controller = DynamicWindow(levels(grid), CAR, goal)
    poses, states = [start], [controller.init()]
    while len(states) <= steps:
        states.append(controller.step(states[-1], poses[-1]))
        if states[-1].status is DwaStatus.ARRIVED:
            break
        poses.append(move(poses[-1], states[-1].control))
    return np.array(poses), states


CASES = [
    (ROOM, np.array([0.5, 1.5, 0.0]), np.array([3.5, 1.5])),
    (ROOM, np.array([3.5, 1.5, 0.0]), np.array([0.5, 1.5])),  # behind the car: it may as well back
    (ROOM, np.array([0.5, 0.5, 0.0]), np.array([3.0, 2.5])),
    (COLUMN, np.array([0.5, 1.5, 0.0]), np.array([3.5, 1.5])),
    (COLUMN, np.array([0.5, 1.5, 1.57]), np.array([3.5, 1.4])),
    (DEAD_END, np.array([0.5, 1.0, math.pi]), np.array([2.6, 0.3])),  # out backwards
]


@pytest.mark.parametrize(("grid", "start", "goal"), CASES)
def test_it_arrives_without_collision(grid, start, goal):
    poses, states = run(grid, start, goal)
    assert states[-1].status is DwaStatus.ARRIVED
    assert math.hypot(*(poses[-1, :2] - goal)) <= 0.05
    assert not collides(solid(grid), poses).any()


@pytest.mark.parametrize(("grid", "start", "goal"), CASES)
def test_commands_are_in_the_window(grid, start, goal):
    _, states = run(grid, start, goal)
    reach = np.array([DwaConfig().acceleration, DwaConfig().steering_rate]) * CAR.dt
    for before, after in itertools.pairwise(states):
        assert np.all(np.abs(after.control) <= CAR.limits + 1e-12)
        if after.status is DwaStatus.DRIVING:
            assert np.all(np.abs(after.control - before.control) <= reach + 1e-9)


def test_it_can_stop_before_an_obstacle_ahead():
    """At every step towards a wall, braking at twice the planned deceleration stops the car before a collision."""
    grid = occupied(3.0, 1.0)
    controller = DynamicWindow(levels(grid), CAR, np.array([2.6, 0.5]))
    state, planar = replace(controller.init(), control=np.array([0.6, 0.0])), np.array([0.4, 0.5, 0.0])
    for _ in range(60):
        state = controller.step(state, planar)
        if state.status is not DwaStatus.DRIVING:
            break
        planar = move(planar, state.control)
        stopped = planar + np.array([state.control[0] ** 2 / (2.0 * 1.2), 0.0, 0.0])
        assert not collides(solid(grid), stopped[None]).any()
    assert planar[0] > 2.0  # it went there


def test_an_unreachable_goal_is_refused_at_once():
    state = DynamicWindow(levels(SEALED), CAR, np.array([2.5, 1.0])).step(
        DwaState(np.zeros(2)), np.array([0.5, 0.5, 0.0])
    )
    assert state.status is DwaStatus.NO_PATH
    np.testing.assert_array_equal(state.control, 0.0)


def test_a_boxed_in_car_stands_still():
    """In a box hardly longer than the car no command is admissible in either gear, and the status reports it."""
    grid = occupied(0.5, 0.45)
    state = DynamicWindow(levels(grid), CAR, np.array([0.25, 0.22])).step(
        DwaState(np.zeros(2)), np.array([0.12, 0.22, 0.0])
    )
    assert state.status in (DwaStatus.BLOCKED, DwaStatus.NO_PATH)
    np.testing.assert_array_equal(state.control, 0.0)


def test_without_progress_it_backs_up():
    """A car that faces a wall, with its goal behind it, first drives backwards."""
    grid = occupied(3.0, 3.0, (1.4, 0.6, 1.5, 2.4))
    start, goal = np.array([1.0, 1.5, 0.0]), np.array([2.2, 1.5])
    poses, states = run(grid, start, goal)
    assert states[1].control[0] < 0.0
    assert not collides(solid(grid), poses).any()


def test_from_a_pose_in_collision_it_leaves_without_going_deeper():
    grid = occupied(3.0, 2.0)
    start, table = np.array([1.0, 0.125, 0.3]), levels(grid)
    assert table.at(start) == COLLIDING
    poses, _ = run(grid, start, np.array([2.0, 1.0]))
    level = table.at(poses)
    assert (level[8:] < COLLIDING).all()


def test_it_cannot_reach_a_goal_that_one_arc_does_not_reach():
    """A goal at a right angle, too near to turn to, between two walls: a plan reaches it, one arc does not."""
    grid = occupied(3.0, 0.75)
    start, goal = np.array([1.4, 0.22, 0.0]), np.array([1.4, 0.5])
    _, states = run(grid, start, goal, steps=20)
    assert states[-1].status is not DwaStatus.ARRIVED
    assert any(s.status is DwaStatus.RECOVERING for s in states)


def test_the_same_state_has_the_same_answer():
    controller = DynamicWindow(levels(COLUMN), CAR, np.array([3.5, 1.5]))
    planar = np.array([0.7, 1.4, 0.2])
    once, again = (controller.step(controller.init(), planar) for _ in range(2))
    np.testing.assert_array_equal(once.control, again.control)


@pytest.mark.parametrize("goal", [np.zeros(3), np.array([np.nan, 0.0])])
def test_bad_input_is_named(goal):
    with pytest.raises(InputError, match="goal"):
        DynamicWindow(levels(ROOM), CAR, goal)
