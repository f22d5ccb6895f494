"""Test navigation without a map: the robot arrives, and with a camera that fails it never claims to have arrived.

The world is that of ``test_agents``: images are rendered from a map, which the agent does not get.
"""

import math

import numpy as np
import pytest

from tests.agents.test_agents import FLOOR, ROBOT, TABLE, WALL, context, drive, learned, observe
from tests.agents.test_lost_robots import FROM, GOAL, NEAR, START, dark, frozen, run
from tests.helpers.box_rooms import free_space
from vssm_gym.agents.navigation.slam_nav import CONFIG, SlamNavAgent
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.agents.shared.mapping import MapAtObservedPose
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.recovery import Response
from vssm_gym.agents.shared.surroundings import GrowingMap, KnownMap
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.planning.traversability import TraversabilityConfig

__all__ = ["learned"]  # the fixture


class Driven:
    """Give a navigator the face of an agent that ``drive`` runs."""

    def __init__(self, navigator: Navigator) -> None:
        self.navigator, self.reset, self.act = navigator, navigator.reset, navigator.act


def at_true_pose(unknown: float) -> Driven:
    """Return ``slam_nav`` with the pose observed, where unknown space costs so much."""
    return Driven(Navigator(GrowingMap(MapAtObservedPose(), TraversabilityConfig(unknown=unknown)), CONFIG))


@pytest.mark.slow
def test_a_robot_arrives_in_an_apartment_that_nobody_has_mapped(learned):
    agent = SlamNavAgent()
    ended = drive(agent, None, START, GOAL, seen=learned)
    assert ended.stopped
    assert ended.decisions[-1].status.startswith("arrived")
    assert ended.away(GOAL) <= NEAR
    shortest = Geodesics(free_space([WALL, TABLE], ROBOT.radius, FLOOR)).length(START[:2], GOAL, NEAR)
    assert ended.driven < 1.3 * shortest
    assert agent.map.table is not None
    plan = agent.plan
    assert {FREE, OCCUPIED, UNKNOWN} <= set(np.unique(plan.cells).tolist())
    assert plan.state(np.array([2.5, 1.0])) == OCCUPIED  # the wall, which it has driven around


@pytest.mark.slow
def test_the_plan_changes_only_where_what_lies_ahead_has(learned):
    """Without anything new to see the planner is not called: neither in a known map nor where all was seen."""
    for surroundings, world in ((KnownMap(TruePose()), learned), (GrowingMap(MapAtObservedPose()), None)):
        navigator, calls = Navigator(surroundings, CONFIG), []
        plan = navigator._plan
        navigator._plan = lambda *a, plan=plan, calls=calls, **k: calls.append(1) or plan(*a, **k)
        ended = drive(Driven(navigator), world, np.array([0.6, 0.6, 0.3]), np.array([1.9, 2.4]), seen=learned)
        assert ended.stopped
        steps = sum(decision.action[2] > 0.0 for decision in ended.decisions)
        assert steps >= 8
        assert len(calls) <= 4 + 0.5 * steps  # two of them before the first step; others as the room comes into view
        if world is not None:
            assert len(calls) <= 6


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [0.4, math.inf])
def test_unknown_space_is_crossed_or_explored(learned, unknown):
    """A robot that must not cross unknown space drives to frontiers until it sees a path."""
    agent = at_true_pose(unknown)
    ended = drive(agent, None, START, GOAL, seen=learned)
    assert ended.stopped
    assert ended.away(GOAL) <= NEAR
    explored = ended.decisions[-1].responses.get(Response.EXPLORE.value, 0)
    assert (explored > 0) == math.isinf(unknown)


@pytest.mark.slow
def test_a_goal_that_is_walled_in_ends_with_the_reason(learned):
    """The goal is beyond the outer wall: no path leads there, and nothing is left to explore."""
    agent = at_true_pose(0.4)
    ended = drive(agent, None, START, np.array([7.5, 1.0]), seen=learned, steps=400)
    assert ended.stopped
    assert "gave up" in ended.decisions[-1].status
    assert ended.decisions[-1].gives_up


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["frozen for 20", "frozen for ever", "black", "carried off"])
def test_a_camera_that_fails_leads_to_no_wrong_arrival(learned, fault):
    faults = {"frozen for 20": frozen(20), "frozen for ever": frozen(10_000), "black": dark}
    carried = np.array([4.4, 2.6, 0.3]) if fault == "carried off" else None
    decisions, _, away = run("slam_nav", learned, faults.get(fault, lambda k, images: images[-1]), carried, steps=300)
    assert len(decisions) < 299  # no endless episode
    assert decisions[-1].action[3] > 0.5
    assert decisions[-1].gives_up or away <= NEAR
    if fault in ("frozen for ever", "black"):
        assert decisions[-1].gives_up
        assert any("lost" in decision.status for decision in decisions[FROM:])


def test_the_first_observation_without_depth_is_no_error(learned):
    """A robot that begins in front of something too near to see still begins."""
    agent = SlamNavAgent()
    blind = observe(START, GOAL, None)
    agent.reset(context(None, START), blind, 0)
    decision = agent.act(blind)
    assert decision.action[2] == 0.0
