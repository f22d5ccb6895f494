"""Test goals seen from the robot, and the poses that they are seen from."""

import numpy as np
import pytest
from gymnasium import spaces

from vssm_gym.envs.conventions.relative_goal import (
    reckoned,
    relative_goal,
    sensed_pose,
    with_relative_goal,
)
from vssm_gym.envs.robots.registry import ROBOTS
from vssm_gym.envs.sensors.base import GroundBody
from vssm_gym.envs.sensors.gps_compass import GpsCompassConfig, GpsCompassSensor
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle

POSE = np.array([1.0, 2.0, np.pi / 2])


def test_a_goal_pose_by_hand():
    """At (1, 2) looking along +y: a target 2 m to the left, looking back the way the robot came."""
    goal = {"goal": np.array([-1.0, 2.0, -np.pi / 2], np.float32)}
    np.testing.assert_allclose(relative_goal(goal, POSE)["goal"], [2.0, 0.0, 1.0, -1.0, 0.0], atol=1e-6)


def test_the_sensed_pose_prefers_the_observed_one_then_gps_then_the_commands():
    pose, gps, start, own = np.array([5.0, 6.0, 0.5]), np.array([3.0, 1.0]), POSE, np.array([9.0, 9.0, 0.0])
    sensed = {"gps": gps.astype(np.float32), "compass": np.array([0.25], np.float32)}
    np.testing.assert_array_equal(sensed_pose({"pose": pose} | sensed, start, own), pose)
    # 3 m forward of (1, 2) along +y, and 1 m to the left
    np.testing.assert_allclose(sensed_pose(sensed, start, own), [0.0, 5.0, np.pi / 2 + 0.25], atol=1e-6)
    np.testing.assert_array_equal(sensed_pose({}, start, own), own)


def test_exact_gps_and_compass_give_the_true_pose_of_a_batch():
    rng = np.random.default_rng(0)
    starts, poses = rng.uniform(-3.0, 3.0, (2, 6, 3))
    read = []
    for start, pose in zip(starts, poses, strict=True):
        sensor = GpsCompassSensor(GpsCompassConfig())
        sensor.seed(np.random.default_rng(1))
        sensor.begin(GroundBody.at(start, np.eye(4), 0.2))
        read.append(sensor.measure(GroundBody.at(pose, np.eye(4), 0.2)))
    batch = {key: np.stack([one[key] for one in read]) for key in ("gps", "compass")}
    found = sensed_pose(batch, starts, starts)
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=1e-5)
    np.testing.assert_allclose(wrap_angle(found[:, 2] - poses[:, 2]), 0.0, atol=1e-5)


@pytest.mark.parametrize("name", ROBOTS)
def test_reckoning_is_the_robots_motion_without_noise(name):
    robot = ROBOTS[name]()
    command = 0.5 * robot.bounds[1]
    expected = robot.execute(POSE, command, robot.parse_noise("none"), np.random.default_rng(3))
    np.testing.assert_array_equal(reckoned(POSE, command, robot), expected)


def test_a_goal_that_is_relative_or_missing_is_refused():
    point = spaces.Dict({"goal": spaces.Box(-1000.0, 1000.0, (2,), np.float32)})
    relative = with_relative_goal(point)
    assert relative["goal"].shape == (3,)
    for space in (relative, spaces.Dict({}), spaces.Box(0.0, 1.0)):
        with pytest.raises(InputError, match="RelativeGoal"):
            with_relative_goal(space)
