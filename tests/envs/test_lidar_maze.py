"""Test LidarMaze: spaces, seeds, phases of a step, pictures, and errors."""

import inspect
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.helpers.plane.maze_episodes import ID, MAZE, TASK, act, make, random_actions, rollout
from vssm_gym.envs.lidar_maze import LidarMazeEnv
from vssm_gym.envs.maze_noise import MOTION_NOISE
from vssm_gym.envs.tasks.mazes import MAZES, ROBOT, load_maze
from vssm_gym.errors import InputError


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"observe_pose": True, "end_on": "reach", "noise": "high", "sensor_noise": "high"},
        {"task": "explore", "sensor_noise": "mid"},
        {"task": "explore", "reward": "sparse", "beams": 1},
    ],
)
def test_gymnasium_accepts_it(keywords):
    env = gym.make(ID, render_mode="rgb_array", **keywords).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=False)


@pytest.mark.parametrize("task", ["navigate", "explore"])
def test_stable_baselines_accepts_it(task):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="the rl extra is not installed")
    checker.check_env(make(noise="low", task=task))


def test_it_is_made_by_its_id_with_a_limit_of_steps():
    env = gym.make(ID, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(act(turn=0.1))[3] for _ in range(3)] == [False, False, True]
    assert gym.spec("vssm_gym/LidarMaze-v0").max_episode_steps == 1000
    assert (env.unwrapped.maze.name, env.unwrapped.noise) == ("rooms-v1", MOTION_NOISE["low"])


@pytest.mark.parametrize("scene", MAZES)
def test_the_same_seed_gives_the_same_bytes(scene):
    noisy = {"scene": scene, "noise": "high", "sensor_noise": "high", "tasks": None}
    env, other = make(**noisy), make(**noisy)
    first = rollout(env, seed=3)
    assert rollout(other, seed=3) == first
    assert rollout(env, seed=3) == first
    assert rollout(env, seed=4) != first


def test_info_and_observation_are_as_documented():
    env = make(noise="low")
    observation, info = env.reset(seed=0)
    assert set(observation) == {"scan", "goal"}  # and so no pose
    assert set(info) == {"pose", "collision", "control", "task", "start_pose"}
    np.testing.assert_array_equal(info["start_pose"], info["task"].start)
    np.testing.assert_allclose(observation["goal"], info["task"].goal, rtol=1e-6)
    observation, _, _, _, info = env.step(act(turn=9.0, step=-1.0))
    assert set(info) == {"pose", "collision", "control"}
    np.testing.assert_allclose(info["control"], [ROBOT.max_turn, 0.0])
    assert env.observation_space.contains(observation)


def test_the_pose_is_observed_on_request():
    env = make(observe_pose=True, noise="mid")
    observation, info = env.reset(seed=1)
    np.testing.assert_allclose(observation["pose"], info["pose"], rtol=1e-6)
    observation, *_, info = env.step(act(turn=0.1, step=0.01))
    np.testing.assert_allclose(observation["pose"], info["pose"], rtol=1e-6)
    assert env.observation_space.contains(observation)


def test_phases_in_turn_equal_reset_and_step():
    """The phases that a vector environment calls one after the other do what ``reset`` and ``step`` do."""
    noisy = {"noise": "high", "sensor_noise": "high"}
    env, phased = make(**noisy), make(**noisy)
    observation, info = env.reset(seed=9)
    phased.begin(9, None)
    phased.sense()
    first = phased.report()
    np.testing.assert_array_equal(observation["scan"], first[0]["scan"])
    assert info["task"] == first[4]["task"] and set(info) == set(first[4])
    for action in random_actions(env, 5):
        phased.advance(action)
        phased.sense()
        one, other = env.step(action), phased.report()
        np.testing.assert_array_equal(one[0]["scan"], other[0]["scan"])
        assert one[1:4] == other[1:4]


def test_rendering_shows_plan_and_readings():
    env = make(render_mode="rgb_array", sensor_noise="low")
    assert env.render() is None
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (480, 480, 3)
    env.step(act(turn=0.2, step=0.02))
    assert (env.render() != picture).any() and picture.std() > 20
    np.testing.assert_array_equal(env.render(), env.render())  # looking draws no noise
    camera = make(render_mode="rgb_array", sensor="camera", beams=8)
    strip = camera.reset(seed=0)[0]["strip"][0]
    angles = camera.planar[2] + 2.0 * np.pi * np.arange(8) / 8
    picture = camera.render()
    for angle, colour in zip(angles, strip, strict=True):  # each column's colour lies in its direction
        at = camera.planar[:2] + 0.055 * np.array([np.cos(angle), np.sin(angle)])
        column, row = np.rint(camera._plan.pixels(at)).astype(int)
        assert np.abs(picture[row, column].astype(int) - colour).max() <= 1
    explorer = make(render_mode="rgb_array", task="explore")
    explorer.reset(seed=0)
    assert explorer.render().shape == (480, 480, 3)
    assert make().render() is None


@pytest.mark.parametrize("when", ["before", "during"])
def test_a_pickled_environment_goes_on(when):
    env = make(noise="high", sensor_noise="high")
    if when == "during":
        env.reset(seed=2)
        env.step(act(turn=0.1, step=0.01))
    copy = pickle.loads(pickle.dumps(env))
    if when == "before":
        env.reset(seed=2)
        copy.reset(seed=2)
    for action in (act(turn=0.1, step=0.01), act(step=0.02)):
        one, other = env.step(action), copy.step(action)
        assert one[0]["scan"].tobytes() == other[0]["scan"].tobytes() and one[1] == other[1]


@pytest.mark.parametrize(
    ("keywords", "field", "expected"),
    [
        ({"scene": "oak"}, "scene", "spiral-v1"),
        ({"noise": "loud"}, "noise", "low"),
        ({"noise": [1, 2]}, "noise", "[1, 2]"),
        ({"sensor_noise": "kinect"}, "sensor_noise", "mid"),
        ({"beams": 0}, "beams", "1 to 4096"),
        ({"beams": True}, "beams", "True"),
        ({"beams": 6.0}, "beams", "6.0"),
        ({"task": "sleep"}, "task", "'explore'"),
        ({"end_on": "whim"}, "end_on", "'reach'"),
        ({"reward": "money"}, "reward", "'sparse'"),
        ({"render_mode": "ansi"}, "render_mode", "'human', 'rgb_array'"),
        ({"captions": 1}, "captions", "True or False"),
        ({"tasks": load_maze("tree-v1").tasks}, "scene_hash", "rooms-v1"),
        ({"tasks": [1]}, "tasks", "[1]"),
        ({"tasks": MAZE.tasks.model_copy(update={"tasks": ()})}, "tasks", "holds a task"),
    ],
)
def test_bad_keywords_are_named(keywords, field, expected):
    with pytest.raises(InputError) as error:
        make(**keywords)
    assert error.value.field == field and expected in str(error.value)


@pytest.mark.parametrize(
    ("action", "found"),
    [
        (np.array([np.nan, 0, 0]), "finite"),
        (np.array([0, np.inf, 0]), "finite"),
        (np.zeros(4), r"shape \(4,\)"),
        (np.zeros((1, 3)), r"shape \(1, 3\)"),
        ([0.0, [0.0, 0.1], 0.0], "3 numbers"),
        ("forward", "3 numbers"),
        (None, "3 numbers"),
    ],
)
def test_bad_actions_are_named_and_change_nothing(action, found):
    env = make()
    env.reset(options={"task": TASK})
    with pytest.raises(InputError, match=found):
        env.step(action)
    np.testing.assert_array_equal(env.planar, TASK.start)


def test_other_options_and_steps_before_reset_are_refused():
    with pytest.raises(InputError, match="no other key than 'task'"):
        make().reset(options={"goal": (0.5, 0.5)})
    with pytest.raises(gym.error.ResetNeeded):
        make().step(act())


def test_every_keyword_is_documented():
    parameters = inspect.signature(LidarMazeEnv).parameters
    assert all(f"        {name}: " in LidarMazeEnv.__doc__ for name in parameters)
