"""Test agents whose goal is an image: they find where it was taken, drive there, and tell look-alikes apart there."""

import numpy as np
import pytest

from tests.agents.test_agents import CAMERA, LOW, context, learned, observe
from tests.helpers.planning_worlds import APART, twin_rooms
from vssm_gym.agents.navigation.astar_image import NOWHERE as NOWHERE_IN_MAP
from vssm_gym.agents.navigation.astar_image import AStarImageAgent
from vssm_gym.agents.navigation.slam_image import NOWHERE, ImageGoalConfig, SlamImageAgent
from vssm_gym.agents.shared.searching.picture_matches import Match
from vssm_gym.envs.robots import execute
from vssm_gym.maps.voxel_map import VoxelMap

__all__ = ["learned"]  # the fixture

NEAR = 0.4  # m, the success radius


def seen(planar: np.ndarray, taken: np.ndarray, m: VoxelMap) -> dict[str, np.ndarray]:
    """Return the observation of ImageNav: the camera's image, and the colours seen from the goal."""
    observation = observe(planar, planar[:2], m)
    del observation["goal"], observation["pose"]
    return observation | {"goal_rgb": observe(taken, planar[:2], m)["rgb"]}


def drive(m: VoxelMap, start: np.ndarray, taken: np.ndarray, agent=None, steps: int = 120, goal_rgb=None):
    """Drive to where an image was taken; return the decisions and the true pose at the end.

    ``goal_rgb`` replaces that image. An agent without a map gets none.
    """
    agent = AStarImageAgent() if agent is None else agent
    rng, planar, other = np.random.default_rng(0), start, {} if goal_rgb is None else {"goal_rgb": goal_rgb}
    agent.reset(context(m if agent.needs_map else None, start), seen(planar, taken, m) | other, 0)
    decisions = []
    for _ in range(steps):
        decisions.append(agent.act(seen(planar, taken, m) | other))
        if decisions[-1].action[3] > 0.5:
            break
        planar = execute(planar, decisions[-1].action[:3], LOW, rng)
    return decisions, planar


@pytest.mark.slow
@pytest.mark.parametrize(
    "taken", [pytest.param((4.3, 0.6, 2.5), marks=pytest.mark.slow), (0.8, 2.2, -0.8), (3.0, 2.0, -2.4)]
)
def test_the_robot_drives_to_where_the_image_was_taken(taken, learned):
    decisions, planar = drive(learned, np.array([1.0, 1.0, 1.0]), np.array(taken))
    assert decisions[-1].status.startswith("arrived")
    assert np.hypot(*(planar[:2] - np.array(taken)[:2])) <= NEAR


def test_a_goal_that_shows_nothing_is_no_error(learned):
    agent, start = AStarImageAgent(), np.array([1.0, 1.0, 1.0])
    observation = seen(start, start, learned) | {"goal_rgb": np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)}
    agent.reset(context(learned, start), observation, 0)
    decision = agent.act(observation)
    assert decision.gives_up
    assert decision.action[3] > 0.5
    assert decision.status.startswith(NOWHERE_IN_MAP)


@pytest.mark.slow
def test_an_image_of_another_room_is_not_arrived_at(learned):
    """The robot compares at every place where the image may have been taken, and gives up."""
    start = np.array([1.0, 1.0, 1.0])
    other = observe(np.array([1.9, 1.7, 0.0]), start[:2], twin_rooms(differ=False))["rgb"]
    decisions, _ = drive(learned, start, start, steps=600, goal_rgb=other)
    assert decisions[-1].gives_up
    assert decisions[-1].status.startswith(NOWHERE_IN_MAP)


@pytest.mark.slow
def test_places_out_of_reach_are_given_up_for_the_next_one():
    """Two equal rooms without a door between them: whichever is likelier, the robot stops in its own."""
    m = twin_rooms(differ=False)
    start, taken = np.array([1.9, 1.7, 0.0]), np.array([0.9, 1.0, -0.6])
    for shift in (0.0, APART):
        here = np.array([shift, 0.0, 0.0])
        decisions, planar = drive(m, start + here, taken + here)
        assert decisions[-1].action[3] > 0.5
        assert np.hypot(*(planar[:2] - (taken + here)[:2])) <= NEAR


@pytest.mark.slow
@pytest.mark.parametrize("taken", [(4.4, 1.2, 2.9), (0.8, 2.2, -0.8), (3.0, 2.0, -2.4)])
def test_the_place_of_an_image_is_found_in_an_apartment_that_nobody_has_mapped(taken, learned):
    agent = SlamImageAgent()
    decisions, planar = drive(learned, np.array([1.0, 1.0, 1.0]), np.array(taken), agent, steps=500)
    assert decisions[-1].status.startswith("arrived")
    assert not decisions[-1].gives_up
    assert np.hypot(*(planar[:2] - np.array(taken)[:2])) <= NEAR
    assert agent.map.table is not None
    assert {"tracking", "planning", "search"} <= set(decisions[0].latency)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["noise", "black", "another room"])
def test_an_image_of_nowhere_is_never_arrived_at(kind, learned):
    """The robot explores all of the apartment and gives up."""
    size, start = (CAMERA.height, CAMERA.width, 3), np.array([1.0, 1.0, 1.0])
    pictures = {
        "noise": np.random.default_rng(0).integers(0, 256, size).astype(np.uint8),
        "black": np.zeros(size, np.uint8),
        "another room": observe(np.array([1.9, 1.7, 0.0]), start[:2], twin_rooms(differ=False))["rgb"],
    }
    decisions, _ = drive(learned, start, start, SlamImageAgent(), steps=500, goal_rgb=pictures[kind])
    assert decisions[-1].action[3] > 0.5
    assert decisions[-1].gives_up
    assert decisions[-1].status == NOWHERE


@pytest.mark.slow
def test_a_match_that_keeps_moving_away_is_refuted(learned, monkeypatch):
    """Each comparison at its place moves the pose on by 0.6 m: the robot follows it three times, and then not again."""
    start = np.array([1.0, 1.0, 1.0])
    agent, observation = SlamImageAgent(), seen(start, start, learned)
    agent.reset(context(None, start), observation, 0)
    decision = agent.act(observation)
    here = agent._navigator.estimate.planar
    ahead = Match(here + np.array([0.6, 0.0, 0.0]), 3.0, 0.9, 0.9)
    monkeypatch.setattr(agent._search, "align", lambda m, poses: [ahead])
    monkeypatch.setattr(agent._search, "agrees", lambda image, planar, pose: True)
    agent._match = Match(here, 3.0, 0.9, 0.9)
    for correction in range(1, ImageGoalConfig().corrections + 1):
        agent._at_match(decision, observation)
        assert agent._corrections == correction and agent._match is ahead
    agent._at_match(decision, observation)
    assert agent._match is None
    agent._search.matches.add(ahead)
    assert not agent._search.matches.all


@pytest.mark.slow
def test_the_same_seed_gives_the_same_commands(learned):
    """Two agents, and one agent in two episodes."""
    start, taken, agent = np.array([1.0, 1.0, 1.0]), np.array([4.3, 0.6, 2.5]), SlamImageAgent()
    runs = [drive(learned, start, taken, one, steps=60)[0] for one in (agent, SlamImageAgent(), agent)]
    first, *others = ([decision.action.tolist() for decision in decisions] for decisions in runs)
    assert all(other == first for other in others)


@pytest.mark.slow
def test_the_next_image_is_looked_for_in_the_map_that_stays(learned):
    """A goal that changes is a new task in the same map: the way back to the start needs no exploration."""
    rng, planar, agent = np.random.default_rng(0), np.array([1.0, 1.0, 1.0]), SlamImageAgent()
    places = [np.array([0.8, 2.2, -0.8]), planar]
    agent.reset(context(None, planar), seen(planar, places[0], learned), 0)
    for taken in places:
        for _ in range(150):
            decision = agent.act(seen(planar, taken, learned))
            if decision.action[3] > 0.5:
                break
            planar = execute(planar, decision.action[:3], LOW, rng)
        assert decision.status.startswith("arrived")
        assert np.hypot(*(planar[:2] - taken[:2])) <= NEAR
