"""Test how a path is followed: in arcs where that is asked for and free, else by turns in place."""

import math

import numpy as np
import pytest

from vssm_gym.agents.shared.following import Follower, FollowingConfig, PlannedPath
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.planning.clearance import ClearanceMap

ROBOT = HolonomicRobot()
ARC, RESOLUTION = 1.0, 0.025
END = np.array([3.0, 2.0])


def floor(wall_y: float | None = None) -> ClearanceMap:
    """Return an empty floor of 4 m by 4 m, occupied beyond ``wall_y``."""
    x, y = np.meshgrid(*[RESOLUTION * np.arange(161)] * 2, indexing="ij")
    border = np.maximum(np.abs(x - 2.0), np.abs(y - 2.0)) - 1.95
    occupancy = border if wall_y is None else np.maximum(border, y - wall_y)
    return ClearanceMap.from_occupancy(occupancy.astype(np.float32), np.zeros(2), RESOLUTION)


def follower(arc: float = ARC) -> Follower:
    return Follower(ROBOT.radius, ROBOT.limits, (0.01, 0.005), FollowingConfig(arc=arc))


def straight(start: np.ndarray, clearance: ClearanceMap, end: np.ndarray = END) -> PlannedPath:
    return PlannedPath(np.stack([start[:2], end]), clearance, 0.05)


@pytest.mark.parametrize("off", [0.2, -0.5, 0.9, 1.1, -3.0])
def test_a_robot_drives_as_it_turns_where_it_looks_near_enough(off):
    start, free = np.array([1.0, 2.0, -off]), floor()
    arc = follower().step(straight(start, free), start, free, 0)
    in_place = follower(0.0).step(straight(start, free), start, free, 0)
    assert in_place[2] == 0.0
    assert arc[0] == in_place[0]
    assert (arc[2] > 0.0) == (abs(off) <= ARC)
    assert (np.abs(arc) <= ROBOT.limits + 1e-12).all()
    assert arc[1] * off >= 0.0  # the offset is to the side of the path


def test_an_arc_that_is_not_free_is_a_turn_in_place():
    """The robot looks at a wall that is near, and its path leads along it."""
    start, walled = np.array([1.0, 2.0, 0.9]), floor(wall_y=2.13)
    command = follower().step(straight(start, walled), start, walled, 0)
    np.testing.assert_allclose(command, [-ROBOT.max_turn, 0.0, 0.0])


@pytest.mark.parametrize("off", [0.3, -0.7, 1.0])
@pytest.mark.parametrize("away", [0.1, 0.5, 2.0])
def test_arcs_arrive_in_fewer_steps_on_paths_that_are_hardly_longer(off, away):
    steps, lengths = [], []
    for arc in (0.0, ARC):
        free, planar, end = floor(), np.array([1.0, 2.0, -off]), np.array([1.0 + away, 2.0])
        count, length = 0, 0.0
        while math.hypot(*(planar[:2] - end)) > 0.02 and count < 100:
            turn, o, s = follower(arc).step(straight(planar, free, end), planar, free, 0)
            planar = planar + np.array([s * math.cos(planar[2] + o), s * math.sin(planar[2] + o), turn])
            count, length = count + 1, length + float(s)
        steps.append(count)
        lengths.append(length)
    assert steps[1] <= steps[0] < 100
    assert lengths[1] <= 1.1 * away + 0.03
