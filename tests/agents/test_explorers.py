"""Test explorers in two rooms: full coverage, no collision, a reason for every stop, and repeatable episodes.

The world is Explore's own; the agents get its observations and never its info.
"""

import itertools
from collections.abc import Mapping

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.agents.base import Agent, AgentContext, Decision
from vssm_gym.agents.registry import AGENTS
from vssm_gym.agents.shared.explorer import ExplorationConfig, Explorer
from vssm_gym.agents.shared.following import FollowingConfig, PlannedPath, points_along
from vssm_gym.agents.shared.own_map import OwnMapConfig
from vssm_gym.agents.shared.strategy import Choice, around
from vssm_gym.envs.explore import ExploreEnv
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.model.transition import MotionNoise, Planar
from vssm_gym.planning.exploration.information import entropy
from vssm_gym.planning.occupancy_grid import FREE

EXPLORERS = [name for name, agent in AGENTS.items() if agent.task == "explore"]
ESTIMATED = {
    "mi_explorer_estimated_pose",
    "frontier_gain_estimated_pose",
    "frontier_gain_scan_estimated_pose",
}  # PRISM estimates their pose
SCENE = two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))
START = np.array([1.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def world() -> ExploreEnv:
    return ExploreEnv(SCENE, noise="low", camera=CameraConfig(width=64, height=48), finish=2.0)


def context(world: ExploreEnv, info: Mapping[str, np.ndarray]) -> AgentContext:
    robot = world.robot
    return AgentContext(
        K=np.array(info["K"]),
        camera=(world.camera.width, world.camera.height),
        T_body_cam=robot.T_body_cam,
        limits=robot.limits,
        dt=robot.dt,
        map=None,
        start_pose=np.array(info["start_pose"]),
        body_length=robot.body_length,
        success_radius=0.4,
        noise=(world.noise.turn, world.noise.step),
        transition=Planar(MotionNoise(world.noise.turn, world.noise.step)),
    )


def explore(agent: Agent, world: gym.Env, steps: int, seed: int = 0) -> tuple[list[Decision], list[dict]]:
    """Return the decisions and infos of an episode of at most ``steps``."""
    observation, info = world.reset(seed=seed, options={"start": START})
    agent.reset(context(world, info), observation, seed)
    decisions, infos = [], [info]
    for _ in range(steps):
        decisions.append(agent.act(observation))
        observation, _, ended, _, info = world.step(decisions[-1].action)
        infos.append(info)
        if ended:
            break
    return decisions, infos


def test_every_explorer_is_registered():
    frontiers = {"frontier_nearest", "frontier_gain", "frontier_gain_scan"}
    observed = {"mi_explorer", "random_viewpoint", "random_walk"} | frontiers
    assert set(EXPLORERS) == observed | ESTIMATED
    for name in EXPLORERS:
        agent = AGENTS[name]
        assert (agent.robot, agent.needs_pose, agent.needs_map) == ("holonomic", name in observed, False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frontier_nearest", "frontier_gain", "mi_explorer"])
def test_explorers_cover_both_rooms_and_stop(name, world):
    agent = AGENTS[name]()
    decisions, infos = explore(agent, world, 500)
    assert decisions[-1].action[3] > 0.5
    assert "finished" in decisions[-1].status
    assert infos[-1]["coverage"] > 0.93
    assert not any(info["collision"] for info in infos)
    assert entropy(agent.map) < -50_000.0
    low, high = np.array([*-world.robot.limits[:2], 0.0, 0.0]), np.array([*world.robot.limits, 1.0])
    for decision in decisions:
        assert decision.status
        assert decision.action.dtype == np.float32
        assert np.all((decision.action >= low - 1e-6) & (decision.action <= high + 1e-6))
        assert set(decision.latency) == {"tracking", "planning", "control"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n == "mi_explorer" or n in ESTIMATED else n for n in EXPLORERS],
)
def test_same_seed_same_actions(name, world):
    """Actions repeat between two objects, and after an episode that ran before."""
    agent = AGENTS[name]()
    runs = [explore(a, world, 25, seed=3)[0] for a in (agent, AGENTS[name](), agent)]
    actions = [np.array([decision.action for decision in run]) for run in runs]
    assert np.array_equal(actions[0], actions[1])
    assert np.array_equal(actions[0], actions[2])


def test_the_believed_floor_plan_is_free_in_truth(world):
    """After the first full turn, cells that are believed to be free are free."""
    agent = AGENTS["frontier_nearest"]()
    explore(agent, world, 34)
    plan = agent._explorer._own.plan()
    free = plan.centres(np.argwhere(plan.cells == FREE))
    space = world.simulation.scene_cache.sampler.space
    assert len(free) * plan.resolution**2 > 4.0
    assert np.mean(space.distance_to_obstacle(free) > 0.0) > 0.99


class _Nothing:
    """Find nothing to do."""

    def reset(self, seed):
        pass

    def choose(self, belief):
        return None


class _Into:
    """Choose a goal inside the wall, which no robot can reach."""

    def reset(self, seed):
        pass

    def choose(self, belief):
        return Choice(np.array([0.0, 2.0]), (), None, "into the wall")


class _Ahead:
    """Choose the other corner, and count the calls."""

    def reset(self, seed):
        self.asked = 0

    def choose(self, belief):
        self.asked += 1
        return Choice(np.array([2.4, 3.2]), (), None, f"choice {self.asked}")


def test_the_viewpoint_is_chosen_again_every_few_steps_of_a_path(world):
    decisions, _ = explore(Explorer(_Ahead()), world, 60)
    on_the_way = [decision.status for decision in decisions if decision.status.startswith("choice")]
    lengths = [len(list(same)) for _, same in itertools.groupby(on_the_way)]
    assert lengths[:3] == [ExplorationConfig().replan_steps] * 3  # then it is there, and is asked at every step


@pytest.mark.parametrize(("strategy", "reason"), [(_Nothing(), "finished"), (_Into(), "boxed in")])
def test_an_explorer_ends_with_a_reason(strategy, reason, world):
    decisions, infos = explore(Explorer(strategy), world, 120)
    assert decisions[-1].action[3] > 0.5
    assert reason in decisions[-1].status
    assert not any(info["collision"] for info in infos)


def test_a_blocked_robot_retreats_and_finally_gives_up_the_goal(world):
    explorer = Explorer(_Into())
    explore(explorer, world, 40)
    near = explorer._own.plan().clearance(START[:2], 1.2)
    # Beside the wall: where the body just fits.
    x = START[0] - np.arange(0.0, 0.9, 0.005)
    planar = np.array([x[near.at(np.column_stack([x, np.full(len(x), START[1])])) > 0.11][-1], START[1], 0.0])
    here = float(near.at(planar[:2]))
    assert here < 0.14
    dismissed, goal = len(explorer._dismissed), np.array([1.0, 2.0])
    for _ in range(FollowingConfig().tries):
        explorer._choice = Choice(goal, (), None, "somewhere")
        explorer._retreat(PlannedPath(np.stack([planar[:2], goal]), near, 0.03), planar, near)
    assert len(explorer._dismissed) == dismissed + 1
    path = points_along(explorer._path.path, 1.0)
    assert (near.at(path) >= here - 1e-3).all()
    assert near.at(path[-1]) > here + 0.1


def test_the_map_is_as_large_as_configured(world):
    agent = Explorer(_Nothing(), own=OwnMapConfig(extent=8.0, slots=2000))
    explore(agent, world, 1)
    assert np.allclose(agent.map.bounds.mean(axis=0)[:2], START[:2], atol=0.3)
    assert 7.5 < np.ptp(agent.map.bounds[:, 0]) < 8.6
    assert int(agent.map.table.refused) == 0


def test_a_full_map_ends_the_run(world):
    decisions, _ = explore(Explorer(_Nothing(), own=OwnMapConfig(extent=8.0, slots=20)), world, 1)
    assert decisions[-1].action[3] > 0.5
    assert "no room" in decisions[-1].status


@pytest.mark.slow
def test_an_explorer_with_an_estimated_pose_reports_when_it_is_lost(world):
    """The estimate stays within centimetres of the true pose; in the dark the robot turns in place and gives up."""
    agent = AGENTS["mi_explorer_estimated_pose"]()
    observation, info = world.reset(seed=0, options={"start": START})
    agent.reset(context(world, info), _without_pose(observation), 0)
    off = []
    for _ in range(60):
        decision = agent.act(_without_pose(observation))
        off.append(np.linalg.norm(decision.pose[:2] - world.planar[:2]))
        observation = world.step(decision.action)[0]
    assert "lost" not in decision.status
    assert max(off) < 0.08
    agent.act(_without_pose(observation))
    before = entropy(agent.map)
    dark = {**_without_pose(observation), **{name: np.zeros_like(observation[name]) for name in ("rgb", "depth")}}
    ends = [agent.act(dark) for _ in range(65)]
    assert all("lost" in decision.status for decision in ends)
    assert [decision.action[3] > 0.5 for decision in ends] == [False] * 64 + [True]
    assert entropy(agent.map) == before


def _without_pose(observation):
    return {key: value for key, value in observation.items() if key != "pose"}


def test_a_missing_pose_is_named(world):
    observation, info = world.reset(seed=0)
    with pytest.raises(InputError, match="observe_pose"):
        AGENTS["random_walk"]().reset(context(world, info), _without_pose(observation), 0)


def test_the_headings_around_make_a_full_turn():
    for heading in (-3.0, 0.0, 2.5):
        looks = np.array([heading, *around(heading)])
        turns = [(b - a + np.pi) % (2.0 * np.pi) - np.pi for a, b in itertools.pairwise(looks)]
        assert np.allclose(turns, 2.0 * np.pi / 3.0)


def test_points_along_a_path():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    points = points_along(path, 1.5, 0.25)
    assert np.allclose(points, [[0, 0], [0.25, 0], [0.5, 0], [0.75, 0], [1, 0], [1, 0.25], [1, 0.5]])
    assert np.allclose(points_along(path, 9.0, 0.25)[-1], [1.0, 1.0])
