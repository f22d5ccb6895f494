"""Test the agents that plan in a model of scans: whole episodes in a maze, what they read, and how they follow."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.plane.scan_room import full_circle
from vssm_gym.agents.navigation.scan_astar import ScanAStarAgent
from vssm_gym.agents.navigation.scan_astar_latent import ScanAStarLatentAgent
from vssm_gym.agents.navigation.scan_goal import ScanGoalAgent
from vssm_gym.agents.navigation.scan_goal_search import ScanGoalSearchAgent
from vssm_gym.agents.navigation.scan_oracle import ScanOracleAgent
from vssm_gym.agents.shared.scans import goal_by_scan
from vssm_gym.agents.shared.scans.following import ahead_of, follow, free_ahead, progress
from vssm_gym.agents.shared.scans.goal_by_scan import RULED_OUT
from vssm_gym.agents.shared.scans.surprises import Surprises
from vssm_gym.envs.lidar_maze import LidarMazeEnv
from vssm_gym.envs.maze_noise import MOTION_NOISE
from vssm_gym.envs.tasks.mazes import ROBOT, load_maze
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols import maze_map
from vssm_gym.eval.protocols.agent_context import agent_context, context_in
from vssm_gym.eval.protocols.episode import run_episode
from vssm_gym.eval.protocols.exact_scans import ExactScans
from vssm_gym.inference.scan_encoder.mode import ScanModes
from vssm_gym.inference.scan_encoder.network import new_encoder
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces
from vssm_gym.inference.scan_encoder.training import EncoderConfig, fit_encoder
from vssm_gym.planning.scans.range_table import RangeTable
from vssm_gym.planning.scans.search import clearance_at

LIMITS = ROBOT.limits[[0, 2]]
MAZE = load_maze("pillars-v1")
EXACT = ExactScans(jnp.asarray(MAZE.rectangles), full_circle())


def episode(agent, task, model=EXACT, encoder=None, **keywords):
    """Run one of the maze's tasks as a sweep does, at noise low."""
    goal = "scan" if encoder is not None else "position"
    env = LidarMazeEnv(
        MAZE.apartment, sensor_noise="low", observe_pose=agent.needs_pose, goal=goal, tasks=MAZE.tasks, **keywords
    )
    given = {"voxel_map": None, "scan_model": model, "scan_encoder": encoder}
    return run_episode(
        env, MAZE.sampler, agent, MAZE.tasks.tasks[task], seed=task, noise=MOTION_NOISE["low"], limits=LIMITS, **given
    )


@pytest.fixture(scope="module")
def navigator():
    return ScanAStarAgent()


@pytest.mark.parametrize("task", [0, 130, 333])
def test_the_bound_reaches_its_goals(task):
    row = episode(ScanOracleAgent(), task)
    assert row["success"]
    assert row["distance_to_goal"] < 0.01  # from the middle of the goal
    assert row["expansions"] > 0
    assert row["location_error_mean"] is None


@pytest.mark.slow
@pytest.mark.parametrize("task", [5, 402])
def test_a_filtered_pose_reaches_them_too(navigator, task):
    row = episode(navigator, task)
    assert row["success"]
    assert row["location_error_max"] < 0.02


@pytest.mark.slow
def test_a_learned_maze_is_navigated_from_end_to_end(tmp_path):
    """One traversal, its map, its encoder: a goal by its place and a goal by its scan."""
    path = maze_map.ensure_map("pillars-v1", tmp_path, seed=0)
    assert maze_map.ensure_map("pillars-v1", tmp_path, seed=0) == path  # kept
    with pytest.raises(InputError, match="seed"):
        maze_map.ensure_map("pillars-v1", tmp_path, seed=1)
    learned = maze_map.load_map(path)
    assert learned.poses.shape == (maze_map.TRAVERSAL_STEPS + 1, 3)
    assert episode(ScanAStarAgent(), 222, learned.model)["success"]
    assert episode(ScanGoalAgent(), 222, learned.model, learned.encoder)["success"]
    assert path.with_name("pillars-v1-encoder.npz").is_file()
    row = episode(ScanAStarLatentAgent(), 222, learned.latent(MAZE))
    assert row["success"] and row["location_error_max"] < 0.08
    again = maze_map.load_map(path).latent(MAZE)  # from the file
    states = jnp.asarray(learned.poses[:5])
    np.testing.assert_allclose(again.ranges(states), learned.latent(MAZE).ranges(states), atol=1e-4)


@pytest.mark.slow
def test_a_goal_is_found_by_its_scan():
    """With the true map: the place that the encoder and the model agree on is the goal's."""
    poses = np.concatenate([MAZE.space.sample(np.random.default_rng(1), 400), np.zeros((400, 1))], axis=1)
    encoder, _ = fit_encoder(EXACT, VisitedPlaces.of(poses, 0.02), EncoderConfig(scans=8192, updates=2000, batch=128))
    assert np.mean([episode(ScanGoalAgent(), task, encoder=encoder)["success"] for task in (60, 300, 480)]) == 1.0


@pytest.mark.slow
def test_an_episode_that_goes_on_sends_it_to_the_next_place(monkeypatch):
    """Two places explain the scan and the likelier one is wrong: its stop ends nothing, and it drives to the other."""
    task = MAZE.tasks.tasks[60]
    other = next(t.goal for t in MAZE.tasks.tasks if 0.2 < math.dist(t.goal, task.goal) < 0.3)
    places = np.array([[*other, 0.0], [*task.goal, 0.0], [0.5, 0.5, 0.0]])
    found = ScanModes(places, np.array([3.0, 2.5, 2.0 - RULED_OUT]))
    monkeypatch.setattr(goal_by_scan, "modes_of", lambda *_: found)
    encoder = new_encoder(jax.random.key(0), 64, 1.5, VisitedPlaces.of(places, 0.02), 8, 2)
    row = episode(ScanGoalSearchAgent(), 60, encoder=encoder, end_on="reach")
    assert row["success"] and row["responses"]["another place"] == 1
    stopped = episode(ScanGoalAgent(), 60, encoder=encoder, end_on="stop")
    assert not stopped["success"] and stopped["responses"]["another place"] == 0


def test_the_true_pose_changes_nothing(navigator):
    """It reads the scan and the goal: a wrong pose in the observation leaves its actions as they are."""
    env = LidarMazeEnv(MAZE.apartment, observe_pose=True, tasks=MAZE.tasks)
    observation, info = env.reset(seed=0)
    context = context_in(env, info, None, MOTION_NOISE["low"], LIMITS, EXACT)
    actions = []
    for lie in (0.0, 0.4):
        seen = {**observation, "pose": observation["pose"] + np.float32(lie)}
        navigator.reset(context, seen, 0)
        decisions = [navigator.act(seen) for _ in range(4)]
        actions.append([decision.action for decision in decisions])
    assert np.array_equal(actions[0], actions[1])
    for decision in decisions:
        assert decision.action.dtype == np.float32
        assert np.all(np.abs(decision.action) <= np.array([*LIMITS, 1.0]) + 1e-6)
        assert decision.plan is None or np.allclose(decision.plan[-1], observation["goal"])


@pytest.mark.slow
def test_an_unreachable_goal_is_given_up(navigator):
    env = LidarMazeEnv(MAZE.apartment, tasks=MAZE.tasks)
    observation, info = env.reset(seed=0)
    navigator.reset(context_in(env, info, None, MOTION_NOISE["low"], LIMITS, EXACT), observation, 0)
    outside = {**observation, "goal": np.array([1.5, 0.5], np.float32)}
    for _ in range(12):
        decision = navigator.act(outside)
        if decision.gives_up:
            break
    assert decision.gives_up
    assert decision.action[2] == 1.0
    assert "no path" in decision.status


def test_a_model_must_be_given():
    env = LidarMazeEnv(MAZE.apartment, tasks=MAZE.tasks)
    observation, info = env.reset(seed=0)
    with pytest.raises(InputError, match="scan_model"):
        ScanAStarAgent().reset(agent_context(env, info), observation, 0)
    with pytest.raises(InputError, match="scan_encoder"):
        ScanGoalAgent().reset(agent_context(env, info), observation, 0)


def test_a_goal_that_is_a_scan_is_the_scan_at_the_goal():
    env = LidarMazeEnv(MAZE.apartment, goal="scan", sensor_noise="high", tasks=MAZE.tasks)
    observation, info = env.reset(seed=3)
    assert "goal" not in observation
    again, _ = env.reset(seed=9, options={"task": info["task"]})
    assert np.array_equal(observation["goal_scan"], again["goal_scan"])  # of the task, not of the seed
    headings = np.linspace(-np.pi, np.pi, 2000)
    states = np.concatenate([np.tile(info["task"].goal, (2000, 1)), headings[:, None]], axis=1)
    off = np.abs(np.asarray(EXACT.ranges(jnp.asarray(states, jnp.float32))) - observation["goal_scan"]).max(axis=1)
    assert off.min() < 0.05  # one of the headings is its own; beyond an edge ranges jump
    assert env.observation_space.contains(observation)
    with pytest.raises(InputError, match="goal"):
        LidarMazeEnv(MAZE.apartment, goal="image")


def test_it_follows_a_path_without_noise():
    """Around a corner: never farther from it than the look ahead cuts, and to its end."""
    path = np.array([[0.1, 0.1], [0.4, 0.1], [0.4, 0.5]])
    pose, segment, most = np.array([0.1, 0.1, 2.0]), 0, 0.0
    for _ in range(80):
        at = progress(path, pose[:2], segment)
        segment, most = at.segment, max(most, at.distance)
        turn, step = follow(pose, path, at, LIMITS, 0.025, math.radians(20.0))
        assert abs(turn) <= LIMITS[0] + 1e-9
        assert 0.0 <= step <= LIMITS[1] + 1e-9
        pose = pose + np.array([step * math.cos(pose[2]), step * math.sin(pose[2]), turn])
        if math.hypot(*(path[-1] - pose[:2])) < 0.002:
            break
    assert math.hypot(*(path[-1] - pose[:2])) < 0.002
    assert most < 0.015
    assert ahead_of(path, progress(path, np.array([0.2, 0.12])), 0.25) == pytest.approx([0.4, 0.15])


def test_no_step_is_commanded_into_a_reading():
    angles = 2.0 * np.pi * np.arange(64) / 64
    ranges = np.full(64, 0.5)
    assert free_ahead(ranges, angles, 0.0125) == pytest.approx(0.5 - 0.0125, abs=1e-3)
    ranges[0] = 0.02
    assert free_ahead(ranges, angles, 0.0125) == pytest.approx(0.0075)
    ranges[0] = 0.01
    assert free_ahead(ranges, angles, 0.0125) == 0.0
    ranges[0], ranges[16] = 0.0, 0.01  # no reading ahead, a wall on the left
    assert free_ahead(ranges, angles, 0.0125) > 0.4


def test_a_wall_that_the_model_misses_is_remembered_for_the_episode():
    """A wall at x = 0.5 of which the model knows nothing: readings of it block the table, until they are forgotten."""
    n = 101
    far = np.full((n, n), 1.0, np.float32)
    predicted = RangeTable(0.0, 0.0, 0.01, far, np.zeros_like(far), np.full((n, n, 64), 1.5, np.float32))
    surprises = Surprises(predicted, near=0.2, above=0.0125)
    angles = 2.0 * np.pi * np.arange(64) / 64
    pose = np.array([0.4, 0.5, 0.3])
    toward = np.cos(pose[2] + angles)
    ranges = np.where(toward > 1e-3, 0.1 / np.maximum(toward, 1e-3), 1.0)
    met = surprises.look(pose, ranges, angles)
    assert len(met) > 10
    np.testing.assert_allclose(met[:, 0], 0.5, atol=1e-6)
    assert clearance_at(surprises.table, 0.5, 0.5) < 0.01
    assert clearance_at(surprises.table, 0.4, 0.5) == pytest.approx(0.1, abs=0.01)
    assert len(surprises.look(pose, ranges, angles)) < len(met)  # no surprise any more
    assert len(surprises.look(pose, np.where(ranges < 0.2, 0.0, ranges), angles)) == 0  # no reading, or a far one
    surprises.forget()
    assert clearance_at(surprises.table, 0.5, 0.5) == 1.0


@pytest.mark.slow
def test_a_model_without_a_wall_does_not_lead_through_it():
    """The model lacks one block of the maze that lies on the way: the robot drives around what it measures."""
    start, goal = np.array([0.1, 0.5, 0.0]), np.array([0.5, 0.5])
    cut = [k for k, row in enumerate(MAZE.rectangles) if max(abs(row[4]), abs(row[5])) < 0.2]
    holed = ExactScans(jnp.asarray(np.delete(MAZE.rectangles, cut[:4], axis=0)), full_circle())
    way = MAZE.sampler.task(tuple(start), tuple(goal))
    env = LidarMazeEnv(MAZE.apartment, sensor_noise="low", tasks=MAZE.tasks)
    row = run_episode(
        env, MAZE.sampler, ScanAStarAgent(), way, seed=0, noise=MOTION_NOISE["low"], limits=LIMITS, voxel_map=None,
        scan_model=holed,
    )  # fmt: skip
    assert row["success"]
