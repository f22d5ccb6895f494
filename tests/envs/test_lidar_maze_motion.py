"""Test the motion and the scan of the maze's robot: walls, and the laws of both noises."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from scipy import stats

from tests.helpers.plane.maze_episodes import LIDAR, MAZE, TASK, act, make, random_actions
from vssm_gym.envs.lidar_maze import LONGEST_RANGE
from vssm_gym.envs.maze_noise import MOTION_NOISE, RANGE_NOISE
from vssm_gym.envs.physics.planar import scan
from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.sensors.lidar import LidarNoise, measured
from vssm_gym.envs.tasks.mazes import MAZES, ROBOT


def test_streams_are_independent():
    """Tasks do not depend on motion noise drawn, motion not on tasks or beams, and scans not on motion noise."""
    env, other = make(noise="high", sensor_noise="high"), make(noise="high", sensor_noise="high", beams=5)
    env.reset(seed=5)
    for _ in range(7):
        env.step(act(turn=0.1, step=0.01))
    other.reset(seed=5)
    assert env.reset()[1]["task"] == other.reset()[1]["task"]
    env.reset(seed=6)
    other.reset(seed=6)
    other.reset()
    poses = []
    for world in (env, other):
        world.reset(options={"task": TASK})
        poses.append(world.step(act(turn=0.1, step=0.01))[4]["pose"])
    np.testing.assert_array_equal(*poses)


@pytest.mark.parametrize("scene", MAZES)
def test_the_robot_is_never_in_a_wall(scene):
    """In thousands of steps at high noise the disc stays outside of every box, by shapely, and the heading in range."""
    env = make(scene=scene, tasks=None, noise="high", reward="sparse", beams=4)
    solid = shapely.union_all(
        [footprint(box) for box in env.maze.apartment.boxes() if box.kind in ("wall", "furniture")]
    )
    poses, hits = [], 0
    for episode in range(4):
        env.reset(seed=episode)
        for turn, step, _ in random_actions(env, 600, seed=episode):
            *_, info = env.step(act(0.3 * turn, max(step, 0.01)))
            poses.append(info["pose"])
            hits += info["collision"]
    x, y, heading = np.transpose(poses)
    assert hits > 100
    assert shapely.distance(solid, shapely.points(x, y)).min() >= ROBOT.radius
    assert shapely.contains_xy(shapely.box(0.0, 0.0, 1.0, 1.0), x, y).all()
    assert (heading >= -np.pi).all() and (heading < np.pi).all()


def test_the_robot_moves_by_the_noise_model():
    env = make(noise="high")
    env.reset(seed=11, options={"task": TASK})
    stream = np.random.default_rng(np.random.SeedSequence(11).spawn(4)[2])
    expected = np.array(TASK.start)
    for action in (act(turn=0.1), act(step=0.01), act(turn=-0.2, step=0.02), act()):
        *_, info = env.step(action)
        turn, step = info["control"]
        expected = execute(expected, np.array([turn, 0.0, step]), MOTION_NOISE["high"], stream)
        assert not info["collision"]
        np.testing.assert_allclose(info["pose"], expected, atol=1e-12)


@pytest.mark.parametrize("level", ["low", "mid", "high"])
def test_motion_errs_by_the_stated_law(level):
    """Turns of 0.3 rad and steps of 1 cm have unbiased normal errors with the stated deviations."""
    noise, rng = MOTION_NOISE[level], np.random.default_rng(0)
    moved = np.array([execute(np.zeros(3), np.array([0.3, 0.0, 0.01]), noise, rng) for _ in range(4000)])
    turn, length = moved[:, 2] - 0.3, np.hypot(moved[:, 0], moved[:, 1]) - 0.01
    assert stats.kstest(turn / noise.turn, "norm").pvalue > 1e-3
    assert stats.kstest(length / noise.step, "norm").pvalue > 1e-3


@pytest.mark.parametrize("level", RANGE_NOISE)
def test_ranges_err_by_the_stated_law(level):
    noise = RANGE_NOISE[level]
    read = measured(np.full(40_000, 0.6), replace(LIDAR, noise=noise), np.random.default_rng(0))
    lost = read == 0.0
    assert stats.binomtest(int(lost.sum()), len(lost), noise.dropout).pvalue > 1e-3 if noise.dropout else not lost.any()
    error = read[~lost] - 0.6
    if noise.floor == 0.0:
        np.testing.assert_allclose(error, 0.0, atol=1e-7)  # float32
    else:
        assert stats.kstest(error / noise.floor, "norm").pvalue > 1e-3


def test_ranges_stay_within_the_space():
    read = measured(np.tile([0.01, 1.4], 5000), replace(LIDAR, noise=LidarNoise(floor=0.5)), np.random.default_rng(0))
    assert read.min() == 0.0 and 0.99 * LONGEST_RANGE < read.max() <= LONGEST_RANGE


def test_the_scan_is_that_of_the_true_pose():
    env, noisy = make(), make(sensor_noise="mid")
    for world in (env, noisy):
        observation, info = world.reset(seed=2, options={"task": TASK})
    exact = scan(info["pose"][None], MAZE.rectangles, 64)[0]
    sensors = np.random.default_rng(np.random.SeedSequence(2).spawn(4)[3])
    config = replace(LIDAR, noise=RANGE_NOISE["mid"])
    np.testing.assert_allclose(observation["scan"], measured(exact, config, sensors), rtol=1e-6)
    observation, *_, info = env.step(act(turn=0.3, step=0.02))
    exact = scan(info["pose"][None], MAZE.rectangles, 64)[0]
    np.testing.assert_allclose(observation["scan"], exact, rtol=1e-6)
    # By hand: TASK starts at (0.1, 0.1), looking along x at the thick wall whose face is at 0.37, below the door.
    observation, _ = env.reset(options={"task": MAZE.sampler.task((0.1, 0.04, 0.0), (0.3, 0.1))})
    east, _, west, south = observation["scan"][::16]
    assert (west, south) == (pytest.approx(0.09), pytest.approx(0.03))
    assert east == pytest.approx(0.27)


def test_custom_noise():
    env = make(noise=ExecutionNoise(0.1, 0.0), sensor_noise=LidarNoise(dropout=1.0))
    observation, _ = env.reset(seed=0)
    assert (observation["scan"] == 0.0).all()
