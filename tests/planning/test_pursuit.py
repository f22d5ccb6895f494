"""Test the path follower: commands within limits, motion along the path's segments, arrival, and few turns."""

import math

import hypothesis.strategies as st
import numpy as np
from hypothesis import given

from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot, execute
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.pursuit import BEND_PASSED, FACING, direction_of_travel, steer

ROBOT = HolonomicRobot()
LIMITS = ROBOT.limits
EXACT = NOISE_LEVELS["none"]
headings = st.floats(-math.pi, math.pi)
points = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


def distance_to_path(xy: np.ndarray, path: np.ndarray) -> float:
    a, b = path[:-1], path[1:]
    along = np.clip(np.sum((xy - a) * (b - a), axis=1) / np.maximum(np.sum((b - a) ** 2, axis=1), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(a + along[:, None] * (b - a) - xy, axis=1).min())


@given(points, headings, st.lists(points, min_size=1, max_size=5))
def test_commands_are_within_limits(xy, heading, path):
    command = steer(np.array([*xy, heading]), np.array(path), LIMITS)
    assert np.all(np.abs(command) <= LIMITS + 1e-12)
    assert command[2] >= 0.0
    assert np.array_equal(ROBOT.clip(command), command)


@given(st.floats(0.02, 0.16), headings)
def test_turns_on_arrival(distance, bend):
    """The step that ends at a bend already turns towards what follows, as far as one command can."""
    corner = np.array([distance, 0.0])
    path = np.array([[0.0, 0.0], corner, corner + np.array([math.cos(bend), math.sin(bend)])])
    turn, offset, step = steer(np.zeros(3), path, LIMITS)
    assert (offset, step) == (0.0, distance)
    assert abs(turn - (np.clip(bend, -LIMITS[0], LIMITS[0]) if abs(bend) > LIMITS[1] else 0.0)) < 1e-9


@given(points, headings, st.lists(points, min_size=2, max_size=5))
def test_drives_only_towards_the_waypoint(xy, heading, path):
    """A step that moves goes straight at a waypoint and does not pass it; a step that does not move turns to it."""
    planar, path = np.array([*xy, heading]), np.array(path)
    turn, offset, step = steer(planar, path, LIMITS)
    ahead = [p for p in path[1:-1] if np.linalg.norm(p - planar[:2]) >= BEND_PASSED] + [path[-1]]
    away = ahead[0] - planar[:2]
    distance, error = float(np.hypot(*away)), float(wrap_angle(np.arctan2(away[1], away[0]) - heading))
    if distance == 0.0:
        assert (turn, offset, step) == (0.0, 0.0, 0.0)
    elif step > 0.0:
        assert abs(offset - error) < 1e-9
        assert step <= distance
        assert turn == 0.0 or step == distance  # it turns on the way only where it arrives at a bend
    else:
        assert abs(error) > LIMITS[1]
        assert turn * error > 0.0
        assert abs(turn) <= abs(error) + 1e-12
        assert offset == 0.0


@given(headings, st.lists(points, min_size=2, max_size=5))
def test_follows_the_path_to_its_end(heading, path):
    """Without noise the robot stays on the path, arrives, and drives its length."""
    path = np.array(path)
    planar, driven, off = np.array([*path[0], heading]), 0.0, 0.0
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    rest = path
    for _ in range(60 + int(length / LIMITS[2]) + 30 * len(path)):
        while len(rest) > 2 and np.linalg.norm(rest[1] - planar[:2]) < BEND_PASSED:
            rest = rest[1:]
        command = steer(planar, rest, LIMITS)
        moved = execute(planar, command, EXACT, np.random.default_rng(0))
        driven += float(np.hypot(*(moved - planar)[:2]))
        planar = moved
        off = max(off, distance_to_path(planar[:2], path))
    assert np.linalg.norm(planar[:2] - path[-1]) < 1e-6
    assert off < BEND_PASSED + 1e-6
    assert driven <= length + 1e-6


def test_a_small_error_costs_no_turn():
    """A 4 degree error is taken by the direction offset: turning would add a heading error."""
    planar = np.array([0.0, 0.0, math.radians(4.0)])
    turn, offset, step = steer(planar, np.array([[0.0, 0.0], [1.0, 0.0]]), LIMITS)
    assert turn == 0.0
    assert abs(offset + planar[2]) < 1e-12
    assert step == LIMITS[2]


def test_half_a_turn_takes_sixteen_steps_and_ends():
    planar, turns = np.array([0.0, 0.0, math.pi - 1e-3]), 0
    while steer(planar, np.array([[0.0, 0.0], [1.0, 0.0]]), LIMITS)[2] == 0.0:
        command = steer(planar, np.array([[0.0, 0.0], [1.0, 0.0]]), LIMITS)
        planar = execute(planar, command, EXACT, np.random.default_rng(0))
        turns += 1
    assert turns == 16  # (180 - 5) / 11.5, rounded up


def test_the_last_step_lands_on_the_end():
    path = np.array([[0.0, 0.0], [0.3, 0.0]])
    planar = np.array([0.23, 0.0, 0.0])
    assert np.allclose(steer(planar, path, LIMITS), [0.0, 0.0, 0.07])
    # However near the end is, the robot goes there: a region that must be entered may begin just behind it.
    assert np.allclose(steer(np.array([0.297, 0.0, 0.0]), path, LIMITS), [0.0, 0.0, 0.003])
    assert np.array_equal(steer(np.array([0.3, 0.0, 0.0]), path, LIMITS), np.zeros(3))


WORLD = HolonomicRobot(direction_frame="world")


@given(points, headings, st.lists(points, min_size=2, max_size=5))
def test_in_the_world_frame_it_drives_at_once_and_turns_meanwhile(xy, heading, path):
    planar, path = np.array([*xy, heading]), np.array(path)
    command = steer(planar, path, WORLD.limits, "world")
    np.testing.assert_array_equal(WORLD.clip(command), command)
    ahead = [p for p in path[1:-1] if np.linalg.norm(p - planar[:2]) >= BEND_PASSED] + [path[-1]]
    away = ahead[0] - planar[:2]
    distance = float(np.hypot(*away))
    after = WORLD.execute(planar, command, EXACT, np.random.default_rng(0))
    expected = planar[:2] + away * min(1.0, WORLD.max_step / max(distance, 1e-12))
    np.testing.assert_allclose(after[:2], expected, atol=1e-9)
    if distance > WORLD.max_step:  # it turns to where it drives, and rests within 5 degrees of it
        error = float(wrap_angle(np.arctan2(away[1], away[0]) - heading))
        assert abs(command[0] - (np.clip(error, -LIMITS[0], LIMITS[0]) if abs(error) > FACING else 0.0)) < 1e-9


@given(points, headings, st.floats(-math.pi, math.pi), st.floats(0.01, 0.16))
def test_the_direction_of_travel_is_that_of_the_robot(xy, heading, direction, step):
    planar, command = np.array([*xy, heading]), np.array([0.0, direction, step])
    for robot in (ROBOT, WORLD):
        after = robot.execute(planar, command, EXACT, np.random.default_rng(0))
        angle = direction_of_travel(planar, command, robot.direction_frame)
        moved = step * np.array([math.cos(angle), math.sin(angle)])
        np.testing.assert_allclose(after[:2] - planar[:2], moved, atol=1e-9)
