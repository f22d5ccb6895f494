"""Test PointNav: spaces, streams, observations, ends of episodes, and errors."""

import inspect
import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.pointnav import POINTNAV_REWARD, PointNavEnv
from vssm_gym.envs.robots import HOLONOMIC_NOISES, NOISE_LEVELS, ExecutionNoise, HolonomicRobot, execute
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.simulation import Simulation
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.envs.tasks.goal_progress import GRID_SPACING, GoalDistance
from vssm_gym.envs.tasks.navigation import Task, TaskSampler, make_tasks
from vssm_gym.errors import InputError

ID = "vssm_gym:vssm_gym/PointNav-v0"
ROBOT = HolonomicRobot()
SMALL = CameraConfig(width=32, height=24)
SCENE = two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))
SAMPLER = TaskSampler(SCENE, ROBOT)
TASK = SAMPLER.task((0.5, 1.0, 0.0), (2.0, 1.0))


def make(**keywords) -> PointNavEnv:
    return PointNavEnv(**{"scene": SCENE, "noise": "none", "camera": SMALL, **keywords})


def act(turn=0.0, offset=0.0, step=0.0, stop=0.0) -> np.ndarray:
    return np.array([turn, offset, step, stop], dtype=np.float32)


def rollout(env: gym.Env, seed: int, steps: int = 12) -> bytes:
    """Return all outputs of the environment in an episode of random actions."""
    observation, info = env.reset(seed=seed)
    rng, parts = np.random.default_rng(0), []
    for _ in range(steps):
        parts += [observation[key].tobytes() for key in sorted(observation)]
        parts += [np.asarray(info[key]).tobytes() for key in ("T_world_cam", "K", "collision", "control")]
        action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32) * [1, 1, 1, 0]
        observation, reward, terminated, truncated, info = env.step(action)
        parts.append(repr((reward, terminated, truncated)).encode())
    return b"".join(parts)


@pytest.mark.parametrize("keywords", [{}, {"observe_pose": True, "end_on": "reach"}, {"reward": "sparse"}])
def test_gymnasium_accepts_it(keywords):
    env = gym.make(ID, scene=SCENE, camera=SMALL, render_mode="rgb_array", **keywords).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=False)


def test_stable_baselines_accepts_it():
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="the rl extra is not installed")
    checker.check_env(make(noise="low"))


def test_it_is_made_by_its_id_with_a_limit_of_steps():
    env = gym.make(ID, scene=SCENE, camera=SMALL, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(act(turn=0.1))[3] for _ in range(3)] == [False, False, True]
    assert gym.spec("vssm_gym/PointNav-v0").max_episode_steps == 500
    default = gym.make(ID, camera=SMALL).unwrapped
    assert (default.apartment.name, default.noise) == ("oak", NOISE_LEVELS["low"])


def test_the_same_seed_gives_the_same_bytes():
    env, other = make(noise="high"), make(noise="high")
    first = rollout(env, seed=3)
    assert rollout(other, seed=3) == first
    assert rollout(env, seed=3) == first
    assert rollout(env, seed=4) != first


def test_streams_are_independent():
    """Tasks do not depend on drawn motion noise, nor the noise on drawn tasks."""
    env, other = make(noise="high"), make(noise="high")
    env.reset(seed=5)
    for _ in range(7):
        env.step(act(turn=0.1, step=0.1))
    other.reset(seed=5)
    assert env.reset()[1]["task"] == other.reset()[1]["task"]

    env.reset(seed=6)
    other.reset(seed=6)
    other.reset()
    moved = []
    for world in (env, other):
        world.reset(options={"task": TASK})
        world.step(act(turn=0.1, step=0.1))
        moved.append(world.planar)
    np.testing.assert_array_equal(*moved)


def test_the_robot_moves_by_the_noise_model():
    env = make(noise="high")
    env.reset(seed=11, options={"task": TASK})
    stream = np.random.default_rng(np.random.SeedSequence(11).spawn(4)[2])
    expected = np.array(TASK.start)
    for action in (act(turn=0.1), act(step=0.1, offset=-0.05), act(turn=-0.2, step=0.16), act()):
        *_, info = env.step(action)
        expected = execute(expected, info["control"], NOISE_LEVELS["high"], stream)
        assert not info["collision"]
        np.testing.assert_allclose(env.planar, expected, atol=1e-9)


def test_info_and_observation_are_as_documented():
    env = make(noise="low")
    observation, info = env.reset(seed=0)
    assert set(observation) == {"rgb", "depth", "goal"}  # and so no pose
    always = {"T_world_cam", "K", "collision", "control", "distance_to_goal", "path_length", "success", "spl"}
    assert set(info) == always | {"task", "start_pose"}
    assert isinstance(info["task"], Task) and info["task"].scene == "two_rooms"
    np.testing.assert_array_equal(info["start_pose"], info["task"].start)
    np.testing.assert_allclose(observation["goal"], info["task"].goal, rtol=1e-6)
    assert observation["rgb"].shape == (24, 32, 3) and observation["depth"].shape == (24, 32)

    observation, _, _, _, info = env.step(act(turn=0.5, offset=-0.5, step=0.5))
    assert set(info) == always
    np.testing.assert_allclose(info["control"], [ROBOT.max_turn, -ROBOT.max_offset, ROBOT.max_step], rtol=1e-6)
    x, y, heading = env.planar
    np.testing.assert_allclose(info["T_world_cam"][:3, 3], [x, y, ROBOT.camera_height])
    np.testing.assert_allclose(info["T_world_cam"][:3, 2], [math.cos(heading), math.sin(heading), 0.0], atol=1e-12)
    np.testing.assert_array_equal(info["K"], SMALL.intrinsics().K)
    assert env.observation_space.contains(observation)


def test_the_image_does_not_depend_on_the_goal():
    env = make()
    one = env.reset(options={"task": TASK})[0]
    other = env.reset(options={"task": SAMPLER.task(TASK.start, (5.0, 3.0))})[0]
    assert one["rgb"].tobytes() == other["rgb"].tobytes() and one["depth"].tobytes() == other["depth"].tobytes()


def test_the_pose_is_observed_on_request():
    env = make(observe_pose=True, noise="mid")
    observation, _ = env.reset(seed=1)
    np.testing.assert_allclose(observation["pose"], env.planar, rtol=1e-6)
    observation, *_ = env.step(act(turn=0.1, step=0.1))
    np.testing.assert_allclose(observation["pose"], env.planar, rtol=1e-6)
    assert env.observation_space.contains(observation)


def test_stop_ends_the_episode_and_decides_success():
    env = make()
    env.reset(options={"task": TASK})
    before = env.planar
    *_, terminated, _, info = env.step(act(turn=0.1, step=0.16, stop=1.0))
    assert terminated and info["success"] is False
    np.testing.assert_array_equal(env.planar, before)  # a stop carries out nothing else
    np.testing.assert_array_equal(info["control"], np.zeros(3))

    env.reset(options={"task": TASK})
    ended = [env.step(act(step=0.1, stop=0.5))[2] for _ in range(12)]  # passes into the success region
    assert not any(ended)
    *_, terminated, _, info = env.step(act(stop=0.51))
    assert terminated and info["success"] is True
    assert env.path_length == pytest.approx(1.2)


def test_reach_ends_on_arrival_for_every_stop_value():
    env = make(end_on="reach")
    env.reset(options={"task": TASK})
    for step in range(1, 13):
        *_, terminated, _, info = env.step(act(step=0.1, stop=1.0))
        assert terminated == (0.5 + 0.1 * step >= 1.6 - 1e-9)
        if terminated:
            assert info["success"] is True
            break
        assert info["success"] is False


def test_dense_rewards_add_up_to_progress_costs_and_prize():
    env = make()
    env.reset(options={"task": TASK})
    rewards = [env.step(act(turn=0.1, step=0.1))[1] for _ in range(5)] + [env.step(act(stop=1.0))[1]]
    assert env.path_length == pytest.approx(0.5)
    distance = GoalDistance(SAMPLER.space)
    distance.aim(np.array(TASK.goal))
    gained = distance(np.array(TASK.start[:2])) - distance(env.planar[:2])
    assert sum(rewards) == pytest.approx(gained - 6 * POINTNAV_REWARD.step_cost)
    near = SAMPLER.task((1.8, 1.0, 0.0), TASK.goal)
    env.reset(options={"task": near})
    assert env.step(act(stop=1.0))[1] == pytest.approx(POINTNAV_REWARD.success - POINTNAV_REWARD.step_cost)


def test_sparse_rewards_success_only():
    env = make(reward="sparse")
    env.reset(options={"task": TASK})
    assert env.step(act(step=0.1))[1] == 0.0 and env.step(act(stop=1.0))[1] == 0.0
    env.reset(options={"task": SAMPLER.task((1.8, 1.0, 0.0), TASK.goal)})
    assert env.step(act(stop=1.0))[1] == POINTNAV_REWARD.success


@given(st.integers(0, 2**32 - 1))
def test_goal_distance_follows_the_exact_geodesic(seed):
    points = SAMPLER.space.sample(np.random.default_rng(seed), 6, 0.02)
    distance, exact = GoalDistance(SAMPLER.space), SAMPLER.geodesics
    assert isinstance(exact, Geodesics)
    distance.aim(points[0])
    for point in points[1:]:
        true = exact.length(point, points[0])
        assert true - GRID_SPACING <= distance(point) <= 1.03 * true + 2.0 * GRID_SPACING


def test_collisions_are_reported_and_stop_the_robot():
    env = make()
    env.reset(options={"task": SAMPLER.task((0.5, 1.0, math.pi), TASK.goal)})
    collisions = [env.step(act(step=0.16))[4]["collision"] for _ in range(4)]
    assert collisions == [False, False, True, True]
    assert env.planar[0] == pytest.approx(0.05 + ROBOT.radius, abs=0.005)
    assert env.path_length == pytest.approx(0.35, abs=0.006)


def test_tasks_are_drawn_from_the_given_set_and_from_options_first():
    tasks = make_tasks(SCENE, ROBOT, 3, "train")
    env = make(tasks=tasks)
    drawn = [env.reset(seed=seed)[1]["task"] for seed in range(20)]
    assert {task.id for task in drawn} == {0, 1, 2} and all(task in tasks.tasks for task in drawn)
    assert env.reset(options={"task": TASK})[1]["task"] == TASK


def test_a_chained_task_may_begin_where_contacts_left_the_robot():
    env = make()
    env.reset(options={"task": SAMPLER.task((0.5, 1.0, math.pi), TASK.goal)})
    for _ in range(4):
        env.step(act(step=0.16))
    chained = SAMPLER.task(tuple(env.planar), (5.0, 3.0))
    _, info = env.reset(options={"task": chained})
    np.testing.assert_array_equal(info["start_pose"], chained.start)


def test_rendering_shows_the_camera_beside_the_plan():
    env = make(render_mode="rgb_array")
    assert env.render() is None
    observation, _ = env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (360, 480 + 360, 3)
    np.testing.assert_array_equal(picture[:360:15, :480:15], observation["rgb"])
    env.step(act(turn=0.2, step=0.16))
    after = env.render()
    assert (after[:, 480:] != picture[:, 480:]).any() and after[:, 480:].std() > 20
    assert make().render() is None


@pytest.mark.parametrize("when", ["before", "during"])
def test_a_pickled_environment_goes_on(when):
    env = make(noise="high")
    if when == "during":
        env.reset(seed=2)
        env.step(act(turn=0.1, step=0.1))
    copy = pickle.loads(pickle.dumps(env))
    if when == "before":
        env.reset(seed=2)
        copy.reset(seed=2)
    for action in (act(turn=0.1, step=0.1), act(step=0.16)):
        a, b = env.step(action), copy.step(action)
        assert a[0]["rgb"].tobytes() == b[0]["rgb"].tobytes() and a[1] == b[1]
        np.testing.assert_array_equal(env.planar, copy.planar)


@pytest.mark.slow
def test_spawned_workers_run_it():
    def build():
        return gym.make(ID, scene=SCENE, camera=SMALL, noise="low")

    vector = gym.vector.AsyncVectorEnv([build] * 2, context="spawn")
    observation, _ = vector.reset(seed=[0, 1])
    assert observation["rgb"].shape == (2, 24, 32, 3)
    alone = build()
    np.testing.assert_array_equal(alone.reset(seed=1)[0]["rgb"], observation["rgb"][1])
    observation, *_ = vector.step(np.tile(act(turn=0.1, step=0.1), (2, 1)))
    np.testing.assert_array_equal(alone.step(act(turn=0.1, step=0.1))[0]["depth"], observation["depth"][1])
    vector.close()


@pytest.mark.parametrize(
    ("keywords", "field", "expected"),
    [
        ({"noise": "loud"}, "noise", "low"),
        ({"noise": [1, 2]}, "noise", "[1, 2]"),
        ({"scene": None}, "scene", "None"),
        ({"scene": 3}, "scene", "Apartment"),
        ({"sensor_noise": "thick fog"}, "sensor_noise", "kinect"),
        ({"observe_pose": "no"}, "observe_pose", "True or False"),
        ({"sensor_noise": 3}, "sensor_noise", "SensorNoise"),
        ({"renderer": "oil"}, "renderer", "'raycast'"),
        ({"physics": "bullet"}, "physics", "'mujoco'"),
        ({"end_on": "whim"}, "end_on", "'reach'"),
        ({"reward": "money"}, "reward", "'sparse'"),
        ({"scene": "no such place"}, "scene", "oak"),
        ({"camera": "160x120"}, "camera", "CameraConfig"),
        ({"render_mode": "ansi"}, "render_mode", "'human', 'rgb_array'"),
        ({"captions": 1}, "captions", "True or False"),
        ({"tasks": make_tasks(two_rooms(), ROBOT, 1, "train")}, "scene_hash", "two_rooms"),
        ({"tasks": [1]}, "tasks", "[1]"),
        ({"tasks": make_tasks(SCENE, ROBOT, 0, "train")}, "tasks", "holds a task"),
    ],
)
def test_bad_keywords_are_named(keywords, field, expected):
    with pytest.raises(InputError) as error:
        make(**keywords)
    assert error.value.field == field and expected in str(error.value)


@pytest.mark.parametrize(
    ("action", "found"),
    [
        (np.array([np.nan, 0, 0, 0]), "finite"),
        (np.array([0, np.inf, 0, 0]), "finite"),
        (np.zeros(3), r"shape \(3,\)"),
        (np.zeros((1, 4)), r"shape \(1, 4\)"),
        ([0.0, [0.0, 0.1], 0.0, 0.0], "4 numbers"),
        ("forward", "4 numbers"),
        (None, "4 numbers"),
    ],
)
def test_bad_actions_are_named_and_change_nothing(action, found):
    env = make()
    env.reset(options={"task": TASK})
    with pytest.raises(InputError, match=found):
        env.step(action)
    np.testing.assert_array_equal(env.planar, TASK.start)


@pytest.mark.parametrize(
    ("task", "field", "expected"),
    [
        (TASK.model_copy(update={"goal": (3.0, 0.5)}), "goal", "wall 4"),
        (TASK.model_copy(update={"goal": (1.0, 3.0)}), "goal", "table"),
        (TASK.model_copy(update={"goal": (50.0, 3.0)}), "goal", "off the floor"),
        (TASK.model_copy(update={"start": (0.0, 1.0, 0.0)}), "start", "wall 3"),
        (TASK.model_copy(update={"scene": "elsewhere"}), "scene", "two_rooms"),
        (TASK.model_copy(update={"start": (math.nan, 1.0, 0.0)}), "start[0]", "finite"),
        (TASK.model_copy(update={"goal": "the kitchen"}), "goal", "kitchen"),
        ({"goal": (1.0, 1.0)}, "options['task']", "dict"),
    ],
)
def test_impossible_tasks_are_named(task, field, expected):
    with pytest.raises(InputError) as error:
        make().reset(options={"task": task})
    assert error.value.field == field and expected in str(error.value)


def test_unreachable_rooms_are_named():
    with pytest.warns(UserWarning, match="two_rooms: cut off from the rest: (west|east); tasks are drawn from"):
        make(scene=two_rooms(openness=0.0, leaves=1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make()


def test_other_misuse_is_named():
    with pytest.raises(gym.error.ResetNeeded):
        make().step(act())
    with pytest.raises(InputError, match="'task'"):
        make().reset(options={"goal": (1.0, 1.0)})


def test_directions_may_be_those_of_the_world():
    env = make(noise="none", direction_frame="world")
    np.testing.assert_allclose(env.action_space.high[:3], [ROBOT.max_turn, math.pi, ROBOT.max_step], rtol=1e-6)
    env.reset(seed=0, options={"task": TASK})
    start = env.planar.copy()
    *_, info = env.step(act(offset=start[2] + 0.5 * math.pi, step=0.1))  # sideways, to the left
    left = [-math.sin(start[2]), math.cos(start[2])]
    assert not info["collision"]
    np.testing.assert_allclose(env.planar, [*(start[:2] + 0.1 * np.array(left)), start[2]], atol=1e-3)
    reckoning = make(noise="none", direction_frame="world", goal="sensed")
    reckoning.reset(seed=0, options={"task": TASK})
    seen, *_ = reckoning.step(act(offset=start[2] + 0.5 * math.pi, step=0.1))
    np.testing.assert_allclose(seen["goal"][0], np.hypot(*(reckoning.planar[:2] - TASK.goal)), atol=1e-2)
    for keywords in ({"robot": "differential"}, {"actions": "discrete"}):
        with pytest.raises(InputError, match="direction_frame: expected 'body'"):
            make(direction_frame="world", **keywords)
    with pytest.raises(InputError, match="direction_frame: expected one of 'body', 'world'"):
        make(direction_frame="map")


def test_the_robot_of_habitat_moves_by_its_own_law():
    env = make(noise="locobot")
    env.reset(seed=11, options={"task": TASK})
    stream = np.random.default_rng(np.random.SeedSequence(11).spawn(4)[2])
    expected = np.array(TASK.start)
    for action in (act(turn=0.1), act(step=0.05, offset=-0.05), act()):
        *_, info = env.step(action)
        expected = HOLONOMIC_NOISES["locobot"].execute(expected, info["control"], stream)
        np.testing.assert_allclose(env.planar, expected, atol=1e-6)
    with pytest.raises(InputError, match="noise: expected two noise levels of one law"):
        make(randomize={"noise": ["none", "locobot"]})
    make(randomize={"noise": ["locobot", "locobot"]}).reset(seed=0)


def test_noise_may_be_given_in_numbers():
    assert make(noise=ExecutionNoise(0.1, 0.2)).noise == ExecutionNoise(0.1, 0.2)


def test_every_keyword_is_documented():
    for documented in (PointNavEnv, Simulation):
        for name in list(inspect.signature(documented.__init__).parameters)[1:]:
            assert f"        {name}: " in (documented.__doc__ or "")
