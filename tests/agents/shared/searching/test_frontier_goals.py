"""Test that places to drive to come one after the other, until everything is seen or dismissed."""

from dataclasses import replace

import numpy as np
import pytest

from tests.agents.test_agents import context
from tests.helpers.planning_worlds import twin_rooms
from vssm_gym.agents.shared.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.searching.frontier_goals import FrontierGoals
from vssm_gym.inference.status import Status
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

HERE = Localization(np.array([2.0, 2.0, 0.0]), np.zeros(3), Status.OK)


def room(*open_sides: str) -> FloorPlan:
    """Return a square room of 3 m in unknown space; walls are missing on the open sides."""
    cells = np.full((40, 40), UNKNOWN, np.int8)
    cells[4:36, 4:36] = OCCUPIED
    cells[5:35, 5:35] = FREE
    for side in open_sides:
        cells[{"east": np.s_[35, 5:35], "west": np.s_[4, 5:35]}[side]] = UNKNOWN
    return FloorPlan(cells, np.where(cells == OCCUPIED, 0.05, -0.05).astype(np.float32), np.zeros(2), 0.1)


@pytest.fixture
def goals() -> FrontierGoals:
    made = FrontierGoals(FrontierGain(FrontierGainConfig(turn=0.8)), (0.01, -0.03))
    made.reset(context(None, HERE.planar), 0)
    return made


@pytest.fixture(scope="module")
def m():
    return twin_rooms(differ=False)  # not read by this strategy


def test_a_choice_ends_where_its_frontier_has_been_seen(goals, m):
    place = goals.choose(m, room("east"), HERE)
    assert place is not None
    assert place[0] > 3.0
    assert abs(goals.heading(HERE.planar)) < 0.7
    assert not goals.is_seen(room("east"))
    assert goals.is_seen(room())
    goals.leave()
    assert goals.heading(HERE.planar) is None
    assert not goals.is_seen(room())


@pytest.mark.parametrize("reached", [True, False])
def test_what_stays_unknown_is_dismissed(goals, m, reached):
    for _ in range(10):
        if goals.choose(m, room("east"), HERE) is None:
            break
        goals.dismiss(room("east"), reached)
    assert goals.choose(m, room("east"), HERE) is None


@pytest.mark.parametrize("facing", [0.0, np.pi])
def test_a_robot_prefers_what_it_looks_at(goals, m, facing):
    """The robot drives to the one ahead of two frontiers that are alike."""
    place = goals.choose(m, room("east", "west"), replace(HERE, planar=np.array([2.0, 2.0, facing])))
    assert place is not None
    assert np.sign(place[0] - 2.0) == np.sign(np.cos(facing))


def test_a_room_without_a_frontier_is_explored(goals, m):
    assert goals.choose(m, room(), HERE) is None
