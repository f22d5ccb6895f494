"""Test the explorers of mazes: they run on scans alone, repeat, keep their pose, and finish a small maze."""

import gymnasium as gym
import numpy as np
import pytest

import vssm_gym  # noqa: F401  (registers the ids)
from tests.helpers.box_rooms import PLAIN
from vssm_gym.agents.base import Agent, decide
from vssm_gym.agents.exploration.maze_frontier import MazeFrontierAgent
from vssm_gym.agents.exploration.maze_information import MazeInformationAgent, MazeInformationConfig
from vssm_gym.agents.exploration.maze_lstm import MazeLstmAgent
from vssm_gym.agents.exploration.maze_random import MazeRandomAgent
from vssm_gym.agents.shared.planar.driving import follow, follow_safely, free_ahead, leave
from vssm_gym.agents.shared.planar.scan_mapper import ScanMapper, planar_entropy
from vssm_gym.envs.scenes.scene import Apartment, Room, Wall
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.planning.exploration.plane.choice import PlaneChoiceConfig
from vssm_gym.planning.exploration.plane.controls import ControlSearchConfig
from vssm_gym.planning.exploration.plane.information import SampledInformationConfig

QUICK = MazeInformationConfig(
    choice=PlaneChoiceConfig(
        ControlSearchConfig(candidates=6, rounds=2), SampledInformationConfig(draws=8, maps=2), places=50, paths=4
    )
)
AGENTS = {
    "maze_information": lambda: MazeInformationAgent(QUICK),
    "maze_frontier": MazeFrontierAgent,
    "maze_lstm": MazeLstmAgent,
    "maze_random": MazeRandomAgent,
}
LIMITS = np.array([np.radians(30.0), 0.02])


def run(agent: Agent, steps: int, scene="pillars-v1", **keywords) -> tuple[list[np.ndarray], list, list[dict]]:
    """Return actions, decisions and infos of the first steps of an episode; the agent gets copies it may not change."""
    keywords = {"noise": "low", "sensor_noise": "low"} | keywords
    env = gym.make("vssm_gym/LidarMaze-v0", scene=scene, task="explore", **keywords)
    observation, info = env.reset(seed=3)
    agent.reset(agent_context(env, info), observation, 5)
    decisions, infos = [], [info]
    for _ in range(steps):
        for value in observation.values():
            value.setflags(write=False)
        decisions.append(decide(agent, observation))
        assert env.action_space.contains(decisions[-1].action)
        observation, *_, info = env.step(decisions[-1].action)
        infos.append(info)
    return [one.action for one in decisions], decisions, infos


@pytest.mark.slow
@pytest.mark.parametrize("name", AGENTS)
def test_an_episode_runs_on_scans_alone_and_repeats(name):
    agent = AGENTS[name]()
    assert (agent.robot, agent.task, agent.needs_pose, agent.needs_map) == ("disc", "explore", False, False)
    first, decisions, infos = run(agent, 60)
    again, _, _ = run(agent, 60)  # the same object: reset forgets the episode before
    np.testing.assert_array_equal(first, again)
    assert infos[-1]["coverage"] > infos[0]["coverage"]
    if decisions[0].pose is not None:
        off = [np.hypot(*(one.pose - info["pose"])[:2]) for one, info in zip(decisions, infos, strict=False)]
        assert max(off) < 0.03


def test_random_draws_follow_the_seed():
    env = gym.make("vssm_gym/LidarMaze-v0", scene="pillars-v1", task="explore")
    observation, info = env.reset(seed=0)
    agent, found = MazeRandomAgent(), []
    for seed in (0, 0, 1):
        agent.reset(agent_context(env, info), observation, seed)
        found.append([agent.act(observation).action.tolist() for _ in range(20)])
    assert found[0] == found[1] != found[2]


def small_maze() -> Apartment:
    """Return a square of 0.4 m with a wall into it."""
    corners = ((0.2, 0.2), (0.6, 0.2), (0.6, 0.6), (0.2, 0.6))
    ends = [*zip(corners, corners[1:] + corners[:1], strict=True), ((0.4, 0.2), (0.4, 0.4))]
    shared = {"thickness": 0.02, "height": 0.2, "front": PLAIN, "back": PLAIN}
    walls = tuple(Wall(start=start, end=end, **shared) for start, end in ends)
    room = Room(name="room", kind="maze", polygon=corners, floor=PLAIN)
    return Apartment(name="small", rooms=(room,), walls=walls, doors=(), furniture=(), ceiling_height=0.2)


def test_the_frontier_explorer_finishes_a_small_maze():
    agent = MazeFrontierAgent()
    _, decisions, infos = run(agent, 330, small_maze())
    ended = [one for one in decisions if one.status == "nothing is left"]
    assert ended and not any(one.action.any() for one in ended)
    assert infos[-1]["coverage"] > 0.8
    known, at = agent.planar_map.observed, np.asarray(agent.planar_map.centres())
    x, y = at[..., 0], at[..., 1]
    free = (x > 0.23) & (x < 0.57) & (y > 0.23) & (y < 0.57) & (np.abs(x - 0.4) > 0.03)
    assert known[free].mean() > 0.95
    assert sum(info["collision"] for info in infos) <= 3


def test_the_map_of_what_is_known_reaches_as_far_as_its_name_says():
    env = gym.make("vssm_gym/LidarMaze-v0", scene="pillars-v1", task="explore")
    observation, info = env.reset(seed=1)
    mapper = ScanMapper()
    mapper.reset(agent_context(env, info), observation)
    away = np.linalg.norm(np.asarray(mapper.map.centres()) - info["pose"][:2], axis=-1)
    assert mapper.map.observed[away < 0.045].any() and not mapper.map.observed[away > 0.05].any()
    assert mapper.seen.observed[away > 0.2].any()
    assert planar_entropy(mapper.seen) < planar_entropy(mapper.map) < 0.0
    empty = PlanarMap.prior(np.zeros(2), np.ones(2), 0.05)
    assert planar_entropy(empty) == pytest.approx(0.0, abs=1e-3)


def test_a_path_is_followed_to_its_end():
    """Without noise, around a corner: the robot stays within half a body of the path."""
    path = np.concatenate(
        [
            np.column_stack([np.linspace(0.0, 0.3, 31), np.zeros(31)]),
            np.column_stack([np.full(30, 0.3), np.linspace(0.01, 0.3, 30)]),
        ]
    )
    pose, open_space = np.array([0.0, 0.0, 2.0]), np.full(64, 1.0)
    for _ in range(80):
        command = follow(pose, path, LIMITS)
        assert abs(command[0]) <= LIMITS[0] and 0.0 <= command[1] <= LIMITS[1]
        pose[:2] += command[1] * np.array([np.cos(pose[2]), np.sin(pose[2])])
        pose[2] += command[0]
        assert np.hypot(*(path - pose[:2]).T).min() < 0.0125
    np.testing.assert_allclose(pose[:2], path[-1], atol=0.006)
    assert follow_safely(pose, path, open_space, LIMITS, 0.0135) is None
    blocked = follow_safely(np.array([0.0, 0.0, 0.0]), path, np.full(64, 0.015), LIMITS, 0.0135)
    assert blocked is None


def test_a_robot_leaves_towards_what_is_free():
    scan = np.full(64, 0.02)
    scan[6:27] = 0.5  # to the left
    command = leave(scan, LIMITS, 0.0135)
    assert command[0] == pytest.approx(LIMITS[0]) and command[1] == 0.0
    assert free_ahead(scan, np.pi / 2, 0.0135) > 0.3 > free_ahead(scan, 0.0, 0.0135)
