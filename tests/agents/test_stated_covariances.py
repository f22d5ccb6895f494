"""Test over the registry that agents which estimate their pose state its covariance, in episodes of a few steps."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import two_rooms
from tests.helpers.plane.maze_episodes import MAZE, TASK
from tests.helpers.plane.scan_room import full_circle
from tests.helpers.planning_worlds import voxel_map
from tests.helpers.straight_policy import straight
from vssm_gym.agents.policy.agent import PolicyAgent
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs.robots import ExecutionNoise, HolonomicRobot
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.car import CarTask
from vssm_gym.envs.tasks.mazes import ROBOT
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.eval.protocols import carnav, explore_episode
from vssm_gym.eval.protocols.agent_context import SCANNER_COMMANDS
from vssm_gym.eval.protocols.episode import run_episode
from vssm_gym.eval.protocols.exact_scans import ExactScans
from vssm_gym.inference.scan_encoder.network import new_encoder
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces

ROOMS = two_rooms()
SMALL = CameraConfig(width=64, height=48)
STEPS = 4
NOISE = ExecutionNoise(0.05, 0.01)
LIMITS = ROBOT.limits[list(SCANNER_COMMANDS)]  # of the maze's robot
EXACT = ExactScans(jnp.asarray(MAZE.rectangles), full_circle())
ENCODER = new_encoder(
    jax.random.key(0), 64, 1.5, VisitedPlaces.of(MAZE.space.sample(np.random.default_rng(0), 50), 0.02), 8, 2
)
WITHOUT = ("oracle", "random", "dist_bug")  # its pose is observed; no estimate; an estimate without a belief
STATING = [name for name, kind in AGENTS.items() if not kind.needs_pose and name not in WITHOUT] + ["policy"]
SLOW = [name for name in STATING if name != "dead_reckoning"]  # their filter reads images: it has to be compiled


class Recorded:
    """Keep the decisions of an agent."""

    def __init__(self, agent):
        self.agent, self.decisions = agent, []
        self.name, self.needs_pose, self.reset = agent.name, agent.needs_pose, agent.reset

    def act(self, observation):
        self.decisions.append(self.agent.act(observation))
        return self.decisions[-1]


def run(name):
    """Run an agent as a sweep does, and return its decisions and its row."""
    agent = Recorded(PolicyAgent(straight()) if name == "policy" else AGENTS[name]())
    robot, task = agent.agent.robot, agent.agent.task
    learned = voxel_map(shapely.box(0.05, 0.05, 5.95, 3.95), [])
    keywords = {"max_episode_steps": STEPS, "observe_pose": agent.needs_pose, "disable_env_checker": True}
    if robot == "disc":
        goal = "scan" if getattr(agent.agent, "goal_by_scan", False) else "position"
        env = gym.make("vssm_gym/LidarMaze-v0", scene=MAZE.apartment, goal=goal, **keywords)
        given = {"scan_model": EXACT, "scan_encoder": ENCODER, "voxel_map": None}
        row = run_episode(env, MAZE.sampler, agent, TASK, seed=3, noise=NOISE, limits=LIMITS, **given)
    elif robot == "car":
        env = gym.make("vssm_gym/CarNav-v0", scene=ROOMS, camera=SMALL, images=not agent.needs_pose, **keywords)
        target = CarTask(id=0, scene=ROOMS.name, start=(0.8, 2.6, 0.3), goal=(2.2, 0.7, 2.5))
        row = carnav.run_episode(env, agent, target, seed=3, voxel_map=learned)
    elif task == "explore":
        env = gym.make("vssm_gym/Explore-v0", scene=ROOMS, camera=SMALL, finish=2.0, **keywords)
        row = explore_episode.run_episode(env, agent, np.array([1.0, 1.0, 0.0]), seed=3)
    else:
        goal = "ImageNav" if task == "imagegoal" else "PointNav"
        env, sampler = (
            gym.make(f"vssm_gym/{goal}-v0", scene=ROOMS, camera=SMALL, **keywords),
            TaskSampler(ROOMS, HolonomicRobot()),
        )
        way = sampler.task((1.0, 1.0, 0.5), (2.6, 3.0))
        row = run_episode(env, sampler, agent, way, seed=5, voxel_map=learned, noise=NOISE)
    env.close()
    return agent.decisions, row


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in (*STATING, *WITHOUT)]
)
def test_an_agent_that_estimates_its_pose_states_a_covariance_and_its_row_the_calibration(name):
    decisions, row = run(name)
    assert len(decisions) > 1
    if name in WITHOUT:
        assert all(decision.covariance is None for decision in decisions)
        assert row["nees"] is row["in_95"] is None
        return
    for decision in decisions:
        covariance = decision.covariance
        assert covariance.shape == (3, 3) and covariance.dtype == np.float64
        assert np.isfinite(covariance).all()
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] >= 0.0
    assert np.trace(decisions[-1].covariance) > np.trace(decisions[0].covariance)  # the start is known
    assert row["nees"] > 0.0 and 0.0 <= row["in_95"] <= 1.0
    assert 0.0 < row["location_error_mean"] < 0.1
