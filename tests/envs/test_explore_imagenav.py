"""Test what ImageNav and Explore add to PointNav's robot; test_environments.py tests the laws of every id."""

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.explore import EXPLORE_REWARD, ExploreEnv
from vssm_gym.envs.imagenav import ImageNavEnv
from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix

SCENE = two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))
KEYWORDS = {"scene": SCENE, "noise": "none", "camera": CameraConfig(width=32, height=24)}
SAMPLER = TaskSampler(SCENE, HolonomicRobot())
TASK = SAMPLER.task((0.5, 1.0, 0.0), (2.0, 1.0))
FORWARD, TURN, STOP = (np.array(a, np.float32) for a in ([0, 0, 0.16, 0], [0.2, 0, 0, 0], [0, 0, 0, 1]))


def test_the_goal_image_is_a_view_from_the_goal():
    env = ImageNavEnv(**KEYWORDS)
    observation, _ = env.reset(seed=0, options={"task": TASK})
    assert set(observation) == {"rgb", "depth", "goal_rgb"}  # and so no position of the goal
    robot, renderer = env.navigation.robot, env.simulation.renderer
    headings = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
    poses = (planar_to_matrix(np.array([*TASK.goal, heading])) @ robot.T_body_cam for heading in headings)
    views = (renderer.render(pose)[0].astype(float) for pose in poses)
    error = min(np.abs(view - observation["goal_rgb"]).mean() for view in views)
    assert error < 2.5  # grey levels, a quarter of a degree away at most


def test_the_picture_shows_the_goals_image_between_view_and_plan():
    env = ImageNavEnv(**KEYWORDS, render_mode="rgb_array")
    observation, _ = env.reset(seed=0, options={"task": TASK})
    picture = env.render()
    assert picture.shape == (360, 480 + 480 + 360, 3)
    np.testing.assert_array_equal(picture[::15, 480:960:15], observation["goal_rgb"])


def test_the_goal_image_belongs_to_the_task_and_stays():
    env = ImageNavEnv(**KEYWORDS | {"sensor_noise": "kinect"})
    first = env.reset(seed=0, options={"task": TASK})[0]["goal_rgb"]
    assert (env.step(FORWARD)[0]["goal_rgb"] == first).all()
    assert (env.reset(seed=1, options={"task": TASK})[0]["goal_rgb"] == first).all()
    elsewhere = SAMPLER.task(TASK.start, (5.0, 3.0))
    assert (env.reset(seed=0, options={"task": elsewhere})[0]["goal_rgb"] != first).any()


def test_imagenav_moves_rewards_and_ends_as_pointnav():
    image, point = ImageNavEnv(**KEYWORDS | {"noise": "mid"}), PointNavEnv(**KEYWORDS | {"noise": "mid"})
    image.reset(seed=4, options={"task": TASK})
    point.reset(seed=4, options={"task": TASK})
    for action in (FORWARD, TURN, FORWARD, STOP):
        a, b = image.step(action), point.step(action)
        assert a[1:4] == b[1:4] and a[4].keys() == b[4].keys()
        np.testing.assert_array_equal(a[0]["depth"], b[0]["depth"])


def test_dense_exploration_rewards_add_up_to_coverage():
    env = ExploreEnv(**KEYWORDS)
    _, info = env.reset(seed=0, options={"start": (1.0, 1.0, 0.0)})
    first, rewards = info["coverage"], []
    for action in (TURN, TURN, FORWARD, FORWARD, TURN):
        _, reward, _, _, info = env.step(action)
        rewards.append(reward)
    assert 0.0 < first < info["coverage"] < 1.0
    assert sum(rewards) == pytest.approx(
        EXPLORE_REWARD.gain * (info["coverage"] - first) - 5 * EXPLORE_REWARD.step_cost
    )
    assert info["path_length"] == pytest.approx(0.32)


@pytest.mark.parametrize(("reward", "prize"), [("sparse", 1.0), ("dense", None)])
def test_exploration_ends_when_finished_or_stopped(reward, prize):
    env = ExploreEnv(**KEYWORDS, reward=reward, finish=0.5)
    env.reset(seed=0, options={"start": (2.0, 2.0, 0.0)})
    rewards = []
    for _ in range(40):
        _, now, terminated, _, info = env.step(TURN)
        rewards.append(now)
        if terminated:
            break
    assert terminated and info["success"] is True and info["coverage"] >= 0.5
    if prize is not None:
        assert rewards[:-1] == [0.0] * (len(rewards) - 1) and rewards[-1] == prize
    env.reset(seed=0, options={"start": (2.0, 2.0, 0.0)})
    _, _, terminated, _, info = env.step(STOP)
    assert terminated and info["success"] is False


def test_exploration_observes_the_pose_by_default():
    env = ExploreEnv(**KEYWORDS)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation["pose"], info["start_pose"], rtol=1e-6)
    assert "pose" not in ExploreEnv(**KEYWORDS, observe_pose=False).reset(seed=0)[0]


@pytest.mark.parametrize(
    ("start", "expected"),
    [((1.0, 3.0, 0.0), "table"), ((50.0, 1.0, 0.0), "floor"), ((1.0, np.nan, 0.0), "finite"), ("here", "here")],
)
def test_impossible_starts_are_named(start, expected):
    with pytest.raises(InputError, match=expected):
        ExploreEnv(**KEYWORDS).reset(options={"start": start})


def test_other_misuse_is_named():
    with pytest.raises(gym.error.ResetNeeded):
        ExploreEnv(**KEYWORDS).step(TURN)
    with pytest.raises(InputError, match="'start'"):
        ExploreEnv(**KEYWORDS).reset(options={"task": TASK})
    with pytest.raises(InputError, match="finish"):
        ExploreEnv(**KEYWORDS, finish=0.0)
