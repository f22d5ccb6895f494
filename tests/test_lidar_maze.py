"""LidarMaze's contract: spaces, streams, laws of noise, walls that hold, when it ends, and what bad input says."""

import inspect
import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
import shapely
from gymnasium.utils.env_checker import check_env
from scipy import stats

from vssm_gym.envs.lidar import LidarConfig, LidarNoise, measured
from vssm_gym.envs.lidar_maze import LONGEST, STEP_COST, SUCCESS_REWARD, LidarMazeEnv
from vssm_gym.envs.maze_noise import MOTION_NOISE, RANGE_NOISE
from vssm_gym.envs.maze_objectives import TILE
from vssm_gym.envs.mazes import MAZES, ROBOT, load_maze
from vssm_gym.envs.planar import scan
from vssm_gym.envs.progress import GoalDistance
from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.envs.solids import footprint
from vssm_gym.errors import InputError

ID = "vssm_gym:vssm_gym/LidarMaze-v0"
LIDAR = LidarConfig(max_range=LONGEST)
MAZE = load_maze("rooms-v1")
TASK = MAZE.sampler.task((0.1, 0.1, 0.0), (0.3, 0.1))


def make(**keywords) -> LidarMazeEnv:
    return LidarMazeEnv(**{"scene": MAZE.apartment, "noise": "none", "tasks": MAZE.tasks, **keywords})


def act(turn=0.0, step=0.0, stop=0.0) -> np.ndarray:
    return np.array([turn, step, stop], dtype=np.float32)


def random_actions(env: gym.Env, n: int, seed: int = 0) -> np.ndarray:
    """Actions that never stop."""
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    return (rng.uniform(low, high, (n, 3)) * [1.0, 1.0, 0.0]).astype(np.float32)


def rollout(env: gym.Env, seed: int, steps: int = 12) -> bytes:
    """Everything the environment says in an episode of random actions."""
    observation, info = env.reset(seed=seed)
    parts = []
    for action in random_actions(env, steps):
        parts += [observation[key].tobytes() for key in sorted(observation)]
        parts += [np.asarray(info[key]).tobytes() for key in ("pose", "collision", "control")]
        observation, reward, terminated, truncated, info = env.step(action)
        parts.append(repr((reward, terminated, truncated)).encode())
    return b"".join(parts)


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
    """Thousands of rough steps at high noise: the disc stays out of every box, by shapely, and the heading in range."""
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


def test_the_robot_moves_as_the_noise_model_says():
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
    """Turns of 0.3 rad and steps of 1 cm from one place: normal errors of the stated widths, without bias."""
    noise, rng = MOTION_NOISE[level], np.random.default_rng(0)
    moved = np.array([execute(np.zeros(3), np.array([0.3, 0.0, 0.01]), noise, rng) for _ in range(4000)])
    turn, length = moved[:, 2] - 0.3, np.hypot(moved[:, 0], moved[:, 1]) - 0.01
    assert stats.kstest(turn / noise.turn, "norm").pvalue > 1e-3
    assert stats.kstest(length / noise.step, "norm").pvalue > 1e-3


@pytest.mark.parametrize("level", RANGE_NOISE)
def test_ranges_err_by_the_stated_law(level):
    noise = RANGE_NOISE[level]
    read = measured(np.full(40_000, 0.6), noise, LIDAR, np.random.default_rng(0))
    lost = read == 0.0
    assert stats.binomtest(int(lost.sum()), len(lost), noise.dropout).pvalue > 1e-3 if noise.dropout else not lost.any()
    error = read[~lost] - 0.6
    if noise.floor == 0.0:
        np.testing.assert_allclose(error, 0.0, atol=1e-7)  # float32
    else:
        assert stats.kstest(error / noise.floor, "norm").pvalue > 1e-3


def test_ranges_stay_within_the_space():
    read = measured(np.tile([0.01, 1.4], 5000), LidarNoise(floor=0.5), LIDAR, np.random.default_rng(0))
    assert read.min() == 0.0 and 0.99 * LONGEST < read.max() <= LONGEST


def test_the_scan_is_that_of_the_true_pose():
    env, noisy = make(), make(sensor_noise="mid")
    for world in (env, noisy):
        observation, info = world.reset(seed=2, options={"task": TASK})
    exact = scan(info["pose"][None], MAZE.rectangles, 64)[0]
    sensors = np.random.default_rng(np.random.SeedSequence(2).spawn(4)[3])
    np.testing.assert_allclose(observation["scan"], measured(exact, noisy.sensor_noise, LIDAR, sensors), rtol=1e-6)
    observation, *_, info = env.step(act(turn=0.3, step=0.02))
    exact = scan(info["pose"][None], MAZE.rectangles, 64)[0]
    np.testing.assert_allclose(observation["scan"], exact, rtol=1e-6)
    # By hand: TASK starts at (0.1, 0.1), looking along x at the thick wall whose face is at 0.37, below the door.
    observation, _ = env.reset(options={"task": MAZE.sampler.task((0.1, 0.04, 0.0), (0.3, 0.1))})
    east, _, west, south = observation["scan"][::16]
    assert (west, south) == (pytest.approx(0.09), pytest.approx(0.03))
    assert east == pytest.approx(0.27)


def test_info_and_observation_hold_what_they_promise():
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


def test_pose_is_observed_where_asked_for():
    env = make(observe_pose=True, noise="mid")
    observation, info = env.reset(seed=1)
    np.testing.assert_allclose(observation["pose"], info["pose"], rtol=1e-6)
    observation, *_, info = env.step(act(turn=0.1, step=0.01))
    np.testing.assert_allclose(observation["pose"], info["pose"], rtol=1e-6)
    assert env.observation_space.contains(observation)


def test_stop_ends_the_episode_and_success_is_judged_there():
    env = make()
    env.reset(options={"task": TASK})
    *_, terminated, _, info = env.step(act(turn=0.1, step=0.02, stop=1.0))
    assert terminated and info["success"] is False
    np.testing.assert_array_equal(info["pose"], TASK.start)  # a stop carries out nothing else
    np.testing.assert_array_equal(info["control"], np.zeros(2))
    env.reset(options={"task": TASK})
    assert not any(env.step(act(step=0.02, stop=0.5))[2] for _ in range(8))
    *_, terminated, _, info = env.step(act(stop=0.51))
    assert terminated and info["success"] is True
    assert env.path_length == pytest.approx(0.16)


def test_reach_ends_within_a_twentieth_whatever_stop_says():
    env = make(end_on="reach")
    env.reset(options={"task": TASK})
    ended = [env.step(act(step=0.02, stop=1.0)) for _ in range(8)]
    assert [done[2] for done in ended] == [False] * 7 + [True]  # 0.02 x 7 = 0.14 is not within 0.05 of 0.2
    assert ended[-1][4]["success"] is True and "success" not in ended[0][4]


def test_dense_rewards_add_up_to_progress_costs_and_prize():
    env = make()
    env.reset(options={"task": TASK})
    rewards = [env.step(act(turn=0.05, step=0.02))[1] for _ in range(5)] + [env.step(act(stop=1.0))[1]]
    distance = GoalDistance(MAZE.space, 0.01)
    distance.aim(np.array(TASK.goal))
    gained = distance(np.array(TASK.start[:2])) - distance(env.planar[:2])
    assert sum(rewards) == pytest.approx(gained - 6 * STEP_COST)
    assert gained > 0.05
    env.reset(options={"task": MAZE.sampler.task((0.27, 0.1, 0.0), TASK.goal)})
    assert env.step(act(stop=1.0))[1] == pytest.approx(SUCCESS_REWARD - STEP_COST)


def test_the_grid_behind_the_reward_follows_the_exact_geodesic():
    distance, exact = GoalDistance(MAZE.space, 0.01), MAZE.sampler.geodesics
    points = MAZE.space.sample(np.random.default_rng(0), 40, 0.002)
    distance.aim(points[0])
    for point in points[1:]:
        true = exact.length(point, points[0])
        assert true - 0.01 <= distance(point) <= 1.03 * true + 0.02


def test_sparse_rewards_success_only():
    env = make(reward="sparse")
    env.reset(options={"task": TASK})
    assert env.step(act(step=0.02))[1] == 0.0 and env.step(act(stop=1.0))[1] == 0.0
    env.reset(options={"task": MAZE.sampler.task((0.27, 0.1, 0.0), TASK.goal)})
    assert env.step(act(stop=1.0))[1] == SUCCESS_REWARD


def test_exploration_pays_for_new_tiles_and_ends_when_all_are_visited():
    env = make(task="explore", end_on="reach", scene="pillars-v1", tasks=None)
    observation, info = env.reset(options={"task": env.maze.sampler.task((0.05, 0.05, 0.0), (0.9, 0.9))})
    assert set(observation) == {"scan"} and set(info) == {
        *("pose", "collision", "control", "coverage", "task", "start_pose")
    }
    counted = int(env.objective.counted.sum())
    assert info["coverage"] == pytest.approx(1.0 / counted)
    steps = [env.step(act(step=0.02)) for _ in range(6)]  # crosses x = 0.1 and stays below 0.2
    assert sum(step[1] for step in steps) == pytest.approx(TILE - 6 * STEP_COST)
    assert steps[-1][4]["coverage"] == pytest.approx(2.0 / counted)
    env.objective.visited[:] = env.objective.counted
    env.objective.visited[1, 0] = False
    _, reward, terminated, _, info = env.step(act(step=0.02))
    assert terminated and info["success"] is True and info["coverage"] == 1.0
    assert reward == pytest.approx(TILE + SUCCESS_REWARD - STEP_COST)
    env.reset(seed=0)
    assert env.objective.visited.sum() == 1


def test_exploration_can_be_stopped_short():
    env = make(task="explore")
    env.reset(seed=0)
    *_, terminated, _, info = env.step(act(stop=1.0))
    assert terminated and info["success"] is False


def test_stages_are_what_a_step_is_made_of():
    """What a vector environment calls one after the other is what ``reset`` and ``step`` do."""
    noisy = {"noise": "high", "sensor_noise": "high"}
    env, staged = make(**noisy), make(**noisy)
    observation, info = env.reset(seed=9)
    staged.begin(9, None)
    staged.look()
    first = staged.report()
    np.testing.assert_array_equal(observation["scan"], first[0]["scan"])
    assert info["task"] == first[4]["task"] and set(info) == set(first[4])
    for action in random_actions(env, 5):
        staged.advance(action)
        staged.look()
        one, other = env.step(action), staged.report()
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


def test_tasks_are_drawn_from_the_given_set_and_from_options_first():
    few = MAZE.tasks.model_copy(update={"tasks": MAZE.tasks.tasks[:3]})
    env = make(tasks=few)
    assert {env.reset(seed=seed)[1]["task"].id for seed in range(20)} == {0, 1, 2}
    assert env.reset(options={"task": TASK})[1]["task"] == TASK


def test_a_chained_task_may_begin_where_contacts_left_the_robot():
    env = make()
    env.reset(options={"task": MAZE.sampler.task((0.1, 0.1, math.pi), TASK.goal)})
    for _ in range(8):
        *_, info = env.step(act(step=0.02))
    assert info["collision"]
    chained = MAZE.sampler.task(tuple(info["pose"]), (0.9, 0.9))
    np.testing.assert_array_equal(env.reset(options={"task": chained})[1]["start_pose"], info["pose"])


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
        ({"render_mode": "human"}, "render_mode", "'rgb_array'"),
        ({"tasks": load_maze("tree-v1").tasks}, "scene_hash", "rooms-v1"),
        ({"tasks": [1]}, "tasks", "[1]"),
        ({"tasks": MAZE.tasks.model_copy(update={"tasks": ()})}, "tasks", "holds a task"),
    ],
)
def test_bad_keywords_are_named(keywords, field, expected):
    with pytest.raises(InputError) as error:
        make(**keywords)
    assert error.value.field == field and expected in str(error.value)


def test_noise_of_ones_own():
    env = make(noise=ExecutionNoise(0.1, 0.0), sensor_noise=LidarNoise(dropout=1.0))
    observation, _ = env.reset(seed=0)
    assert (observation["scan"] == 0.0).all()


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


@pytest.mark.parametrize(
    ("task", "field", "expected"),
    [
        (TASK.model_copy(update={"goal": (0.4, 0.3)}), "goal", "wall"),
        (TASK.model_copy(update={"start": (0.4, 0.3, 0.0)}), "start", "wall"),
        (MAZE.sampler.task((0.365, 0.3, 0.0), (0.3, 0.1)), "start", "touches no wall"),  # 7 mm in: fine for a flat
        (TASK.model_copy(update={"scene": "elsewhere"}), "scene", "rooms-v1"),
        ({"goal": (0.5, 0.5)}, "options['task']", "dict"),
    ],
)
def test_tasks_that_cannot_be_done_are_named(task, field, expected):
    with pytest.raises(InputError) as error:
        make().reset(options={"task": task})
    assert error.value.field == field and expected in str(error.value)


def test_other_options_and_steps_before_reset_are_refused():
    with pytest.raises(InputError, match="no other key than 'task'"):
        make().reset(options={"goal": (0.5, 0.5)})
    with pytest.raises(gym.error.ResetNeeded):
        make().step(act())


def test_every_keyword_is_documented():
    parameters = inspect.signature(LidarMazeEnv).parameters
    assert all(f"        {name}: " in LidarMazeEnv.__doc__ for name in parameters)
