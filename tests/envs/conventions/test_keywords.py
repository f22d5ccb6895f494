"""Test the keywords of policies on every environment that takes them, alone and in vectors."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import vssm_gym  # noqa: F401  (registers the ids)
from tests.envs.conventions.drawn_actions import drawn_action
from tests.helpers.box_rooms import two_rooms
from tests.helpers.car_worlds import yard
from vssm_gym.envs import vector_wrappers, wrappers
from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.navigation import spl

POINT, IMAGE, EXPLORE = (f"vssm_gym/{name}-v0" for name in ("PointNav", "ImageNav", "Explore"))
CAR = "vssm_gym/CarNav-v1"
GPS = {"sensors": ["gps_compass"]}
ROOMS, YARD = two_rooms(), yard(3.0, 3.0)
CASES = [
    (POINT, {"goal": "sensed", **GPS, "actions": "normalized", "end_on": "reach"}),
    (POINT, {"goal": "sensed", "actions": "discrete"}),
    (POINT, {"goal": "true", "actions": "normalized"}),
    (POINT, {"goal": "sensed", "robot": "differential", "actions": "discrete", "end_on": "reach"}),
    (IMAGE, {"actions": "discrete", "images": ["rgb", "depth_image"], "end_on": "reach"}),
    (EXPLORE, {"actions": "discrete", "images": ["depth_image"]}),
    (EXPLORE, {"actions": "normalized"}),
    (CAR, {"goal": "sensed", **GPS, "actions": "normalized", "images": ["depth_image"]}),
    (CAR, {"goal": "true", "targets": "points", "images": False}),
]
each_case = pytest.mark.parametrize(("name", "keywords"), CASES)


def settings(name: str, **keywords) -> dict:
    return {"scene": YARD if name == CAR else ROOMS, "camera": {"width": 16, "height": 12}, "noise": "mid"} | keywords


def make(name: str, **keywords) -> gym.Env:
    return gym.make(name, **settings(name, **keywords))


@each_case
def test_gymnasium_and_stable_baselines3_accept_it(name, keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(symmetric and normalized|render modes).*")
        check_env(make(name, **keywords).unwrapped, skip_render_check=True)
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="the rl extra is not installed")
    checker.check_env(make(name, **keywords), warn=False)


@each_case
def test_vectors_equal_single_environments(name, keywords):
    keywords = keywords | {"max_episode_steps": 3}
    native = gym.make_vec(name, num_envs=2, **settings(name, **keywords))
    oracle = gym.make_vec(name, num_envs=2, vectorization_mode="sync", **settings(name, **keywords))
    assert native.single_observation_space == oracle.single_observation_space
    assert native.single_action_space == oracle.single_action_space
    native.action_space.seed(0)
    (ours, our_infos), (theirs, their_infos) = native.reset(seed=3), oracle.reset(seed=3)
    for _ in range(6):
        assert native.single_observation_space.contains({key: value[0] for key, value in ours.items()})
        for key in ours:
            np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)
        assert our_infos.keys() == their_infos.keys()
        for key in ("distance_to_goal", "path_length", "success", "spl"):
            if key in our_infos:
                np.testing.assert_array_equal(our_infos[key], their_infos[key], err_msg=key)
        actions = native.action_space.sample()
        (ours, rewards, *_, our_infos), (theirs, expected, *_, their_infos) = native.step(actions), oracle.step(actions)
        np.testing.assert_array_equal(rewards, expected)
    native.close()
    oracle.close()


@pytest.mark.parametrize("sensors", [[], [{"sensor": "gps_compass", "noise": "high"}]])
def test_a_sensed_goal_is_that_of_the_wrappers(sensors):
    """The keyword, the wrapper of one environment and that of a vector agree in every number, over two episodes."""
    keywords = settings(POINT, sensors=sensors, max_episode_steps=4)
    ours = gym.make_vec(POINT, num_envs=1, goal="sensed", **keywords)
    many = vector_wrappers.RelativeGoal(gym.make_vec(POINT, num_envs=1, **keywords))
    one = wrappers.RelativeGoal(gym.make(POINT, **keywords))
    assert ours.single_observation_space == many.single_observation_space == one.observation_space
    rng, ended = np.random.default_rng(0), False
    goals = [ours.reset(seed=5)[0]["goal"], many.reset(seed=5)[0]["goal"], one.reset(seed=5)[0]["goal"][None]]
    for _ in range(7):
        np.testing.assert_array_equal(goals[0], goals[1])
        np.testing.assert_array_equal(goals[0], goals[2])
        action = drawn_action(one, rng)
        goals = [env.step(action[None])[0]["goal"] for env in (ours, many)]
        if ended:
            goals.append(one.reset()[0]["goal"][None])
            ended = False
        else:
            seen, _, terminated, truncated, _ = one.step(action)
            goals.append(seen["goal"][None])
            ended = terminated or truncated


def test_a_true_goal_is_seen_from_the_true_pose_and_a_sensed_one_errs_with_its_sensor():
    noisy = [{"sensor": "gps_compass", "noise": "high"}]
    seen = {}
    for goal, sensors in (("true", []), ("sensed", ["gps_compass"]), ("map", []), ("noisy", noisy)):
        env = make(POINT, goal="sensed" if goal == "noisy" else goal, sensors=sensors)
        env.reset(seed=2)
        for _ in range(5):
            seen[goal] = env.step(np.array([0.1, 0.0, 0.1, 0.0], np.float32))[0]["goal"]
        if goal == "map":
            away = seen["map"] - env.unwrapped.planar[:2]
            assert seen["true"][0] == pytest.approx(np.hypot(*away), abs=1e-5)
    np.testing.assert_allclose(seen["sensed"], seen["true"], atol=1e-4)
    assert np.abs(seen["noisy"] - seen["true"]).max() > 0.01


def test_normalised_discrete_and_metric_actions_drive_the_same_robot():
    metric, unit, moves = (make(POINT, actions=form, end_on="reach") for form in ("metric", "normalized", "discrete"))
    for env in (metric, unit, moves):
        env.reset(seed=1)
    turn = np.radians(11.5)
    for number, (si, scaled) in enumerate([((0, 0, 0.16, 0), (0, 0, 1)), ((turn, 0, 0, 0), (1, 0, -1))]):
        expected = metric.step(np.array(si, np.float32))
        for found in (unit.step(np.array(scaled, np.float32)), moves.step(number)):
            np.testing.assert_allclose(found[4]["T_world_cam"], expected[4]["T_world_cam"], atol=1e-6)
            np.testing.assert_allclose(found[4]["control"], expected[4]["control"], atol=1e-6)
            assert found[1] == pytest.approx(expected[1], abs=1e-6)


def test_the_stop_of_discrete_actions_ends_the_episode_and_reach_has_none():
    env = make(POINT, actions="discrete")
    env.reset(seed=0)
    *_, terminated, _, info = env.step(3)
    assert terminated and info["success"] is False and info["spl"] == 0.0
    assert make(POINT, actions="discrete", end_on="reach").action_space.n == 3
    assert make(POINT, end_on="reach").action_space.shape == (4,)  # as ever


def test_images_are_those_of_the_camera():
    env, whole = make(POINT, images=["depth_image"], sensor_noise="kinect"), make(POINT, sensor_noise="kinect")
    seen, expected = env.reset(seed=0)[0], whole.reset(seed=0)[0]
    assert set(seen) == {"depth_image", "goal"}
    depth = expected["depth"]
    np.testing.assert_array_equal(seen["depth_image"][..., 0] == 0, depth == 0.0)
    np.testing.assert_allclose(seen["depth_image"][..., 0] / 51.0, np.minimum(depth, 5.0), atol=0.02)
    assert make(POINT, images=[]).reset(seed=0)[0].keys() == {"goal"}


def test_infos_follow_the_task():
    """The distance falls to the success radius, the path grows, and the SPL is that of the evaluation."""
    env = make(POINT, noise="none", end_on="reach", goal="true")
    observation, info = env.reset(seed=4)
    geodesic, terminated, steps = info["task"].geodesic, False, 0
    assert info["distance_to_goal"] == pytest.approx(geodesic + 0.4, rel=0.03, abs=0.2)
    while not terminated and steps < 400:
        assert info["success"] is False and info["spl"] == 0.0
        _, c, s = observation["goal"]
        before, turn = info, float(np.clip(np.arctan2(s, c), -0.2, 0.2))
        observation, _, terminated, _, info = env.step(np.array([turn, 0.0, 0.1 if abs(turn) < 0.1 else 0.0, 0.0]))
        assert info["path_length"] >= before["path_length"]
        steps += 1
    if terminated:
        assert info["distance_to_goal"] <= 0.4 + 0.1
        assert info["spl"] == pytest.approx(float(spl(True, geodesic, info["path_length"])))
    assert terminated and 0.5 < info["spl"] <= 1.0


@pytest.mark.parametrize(
    ("name", "keywords", "message"),
    [
        (POINT, {"goal": "near"}, "PointNav: goal: expected one of 'map', 'sensed', 'true'"),
        (POINT, {"actions": "si"}, "actions: expected one of 'metric', 'normalized', 'discrete'"),
        (POINT, {"images": "depth"}, "images: expected a list of rgb, depth, depth_image"),
        (POINT, {"images": ["depth", "depth"]}, "each at most once"),
        (POINT, {"images": ["smell"]}, "images"),
        (IMAGE, {"goal": "sensed"}, "ImageNav: goal: expected no such keyword"),
        (CAR, {"goal": "sensed"}, 'CarNav: goal: expected sensors=\\["gps_compass"\\]'),
        (CAR, {"actions": "discrete"}, "CarNav: actions: expected one of 'metric', 'normalized'"),
    ],
)
def test_bad_keywords_are_refused(name, keywords, message):
    with pytest.raises(InputError, match=message):
        make(name, **keywords)


@pytest.mark.parametrize("actions", [np.zeros(2), np.array([0, 3]), np.array([-1, 0]), np.zeros((2, 3), int), None])
def test_a_vector_refuses_bad_moves_and_changes_nothing(actions):
    env = gym.make_vec(POINT, num_envs=2, **settings(POINT, actions="discrete", end_on="reach", noise="none"))
    env.reset(seed=0)
    stood = env.unwrapped.get_attr("planar")
    with pytest.raises(InputError, match="actions"):
        env.step(actions)
    np.testing.assert_array_equal(env.unwrapped.get_attr("planar"), stood)
