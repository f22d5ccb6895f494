"""Test that the native vector environment equals single environments, and restarts episodes as Gymnasium specifies."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import vssm_gym  # noqa: F401  (registers the ids)
from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError

SIMULATED = sorted(name for name in ENVIRONMENTS if "WorldModel" not in name)
SCENE = two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))
CAMERA = {"camera": CameraConfig(width=32, height=24)}
NOISY = {  # every kind of noise, so that one environment's use of it cannot pass unseen
    "vssm_gym/LidarMaze-v0": {"noise": "high", "sensor_noise": "high"},
    "vssm_gym/Flight-v0": {"noise": "high", "sensor_noise": "stereo"},
}
N = 3


def make_vec(name: str, num_envs: int = N, **keywords) -> gym.vector.VectorEnv:
    fixed = {} if "Maze" in name else CAMERA
    if "Maze" not in name and "Flight" not in name:
        fixed = fixed | {"scene": SCENE}
    return gym.make_vec(name, num_envs=num_envs, **fixed | keywords)


def random_actions(env: gym.vector.VectorEnv, rng: np.random.Generator, stops: bool = False) -> np.ndarray:
    if isinstance(env.single_action_space, gym.spaces.Discrete):
        return rng.integers(env.single_action_space.n, size=env.num_envs)
    low, high = env.action_space.low, env.action_space.high
    actions = rng.uniform(low, high).astype(np.float32)
    if env.spec.id != "vssm_gym/Flight-v0":
        actions[:, -1] *= 1.0 if stops else 0.0
    return actions


def same(a: dict, b: dict) -> None:
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


@pytest.mark.parametrize("name", SIMULATED)
@pytest.mark.parametrize("threads", [1, 2])
def test_it_equals_single_environments(name, threads):
    """Gymnasium's own vectorisation of single environments is the oracle, over episodes that end and restart."""
    keywords = NOISY.get(name, {"noise": "high", "sensor_noise": "kinect"}) | {"max_episode_steps": 4}
    ours = make_vec(name, threads=threads, **keywords)
    oracle = make_vec(name, vectorization_mode="sync", **keywords)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert ours.observation_space == oracle.observation_space and ours.action_space == oracle.action_space
    (observation, infos), (expected, oracle_infos) = ours.reset(seed=3), oracle.reset(seed=3)
    same(observation, expected)
    assert infos.keys() == oracle_infos.keys()
    rng, restarts = np.random.default_rng(0), 0
    for _ in range(14):
        actions = random_actions(ours, rng, stops=True)
        ours_now, oracle_now = ours.step(actions), oracle.step(actions)
        same(ours_now[0], oracle_now[0])
        for mine, theirs in zip(ours_now[1:4], oracle_now[1:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        assert ours_now[4].keys() == oracle_now[4].keys()
        np.testing.assert_array_equal(ours_now[4]["control"], oracle_now[4]["control"])
        restarts += int("start_pose" in ours_now[4])
    assert restarts >= 2
    ours.close()
    oracle.close()


def test_observations_are_copies():
    env = make_vec("vssm_gym/PointNav-v0")
    first, _ = env.reset(seed=0)
    kept = {key: value.copy() for key, value in first.items()}
    env.step(random_actions(env, np.random.default_rng(0)))
    same(first, kept)
    env.close()


@pytest.mark.parametrize("name", SIMULATED)
def test_some_environments_may_be_reset_alone(name):
    """The others neither move nor measure; their later outputs are as without the reset."""
    keywords = NOISY.get(name, {"noise": "high", "sensor_noise": "kinect"})
    env, undisturbed = make_vec(name, **keywords), make_vec(name, **keywords)
    env.reset(seed=1)
    undisturbed.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(2):
        actions = random_actions(env, rng)
        before = env.step(actions)[0]
        undisturbed.step(actions)
    observation, infos = env.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(infos["_start_pose"], [False, True, False])
    actions = random_actions(env, rng)
    after, never = env.step(actions)[0], undisturbed.step(actions)[0]
    for key in observation:
        for i in (0, 2):
            np.testing.assert_array_equal(observation[key][i], before[key][i], err_msg=key)
            np.testing.assert_array_equal(after[key][i], never[key][i], err_msg=key)
    assert any((observation[key][1] != before[key][1]).any() for key in observation)
    env.close()
    undisturbed.close()


def test_a_single_reset_restarts_the_step_count():
    env = make_vec("vssm_gym/PointNav-v0", max_episode_steps=5)
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(2):
        env.step(random_actions(env, rng))
    env.reset(options={"reset_mask": np.array([False, True, False])})
    truncated = np.array([env.step(random_actions(env, rng))[3] for _ in range(6)])
    np.testing.assert_array_equal(truncated.argmax(axis=0), [2, 4, 2])
    env.close()


def test_attributes_and_methods_of_all():
    env = make_vec("vssm_gym/PointNav-v0").unwrapped
    env.reset(seed=0)
    assert env.get_attr("success_radius") == (0.4,) * N
    assert [len(pose) for pose in env.get_attr("planar")] == [3] * N
    env.set_attr("mark", [1, 2, 3])
    assert env.get_attr("mark") == (1, 2, 3)
    env.set_attr("mark", 7)
    assert env.get_attr("mark") == (7,) * N
    assert [report[1] for report in env.call("report")] == [0.0] * N
    with pytest.raises(InputError, match="mark"):
        env.set_attr("mark", [1, 2])
    env.close()


def test_closing_one_leaves_those_that_share_its_renderer():
    one, other = make_vec("vssm_gym/PointNav-v0"), make_vec("vssm_gym/PointNav-v0")
    one.reset(seed=0)
    other.reset(seed=0)
    one.close()
    other.step(random_actions(other, np.random.default_rng(0)))
    other.close()


@pytest.mark.parametrize(
    "actions", [np.full((N, 4), np.nan), np.zeros((N - 1, 4)), np.zeros((N, 3)), np.zeros(4), "ahead", None]
)
def test_bad_actions_change_nothing_anywhere(actions):
    env = make_vec("vssm_gym/PointNav-v0", noise="none")
    env.reset(seed=0)
    stood = env.unwrapped.get_attr("planar")
    if isinstance(actions, np.ndarray) and actions.shape == (N, 4):
        actions[0] = [0.1, 0.0, 0.1, 0.0]  # the first is good; the others are not
    with pytest.raises(InputError, match="actions"):
        env.step(actions)
    np.testing.assert_array_equal(env.unwrapped.get_attr("planar"), stood)
    env.close()


def test_a_first_reset_is_one_of_all():
    env = make_vec("vssm_gym/PointNav-v0")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((N, 4), np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    env.close()


def test_environments_take_a_list_of_scenes_in_turn():
    env = make_vec("vssm_gym/PointNav-v0", scene=[SCENE, "oak"])
    assert [one.apartment.name for one in env.unwrapped.envs] == ["two_rooms", "oak", "two_rooms"]
    one, other, third = env.unwrapped.envs
    assert one.simulation.scene_cache is third.simulation.scene_cache is not other.simulation.scene_cache
    assert one.simulation.renderer is third.simulation.renderer
    env.close()


def test_all_environments_can_be_rendered():
    env = make_vec("vssm_gym/PointNav-v0", render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == N and pictures[0].shape == (360, 480 + 360, 3)
    env.close()


def test_each_environments_captions_count_its_own_episode():
    env = make_vec("vssm_gym/PointNav-v0", render_mode="rgb_array", captions=True)
    env.reset(seed=0)
    actions = np.zeros(env.action_space.shape, np.float32)
    rewards = env.step(actions)[1] + env.step(actions)[1]
    assert [one.tally.steps for one in env.envs] == [2] * N
    np.testing.assert_allclose([one.tally.total for one in env.envs], rewards)
    actions[0, -1] = 1.0  # it stops, and begins anew in the step after
    env.step(actions)
    assert env.envs[0].tally.event == "failure" and env.envs[1].tally.event == ""
    env.step(actions)
    assert [one.tally.steps for one in env.envs] == [0] + [4] * (N - 1)
    mask = np.arange(N) == 1
    env.reset(options={"reset_mask": mask})
    assert [one.tally.steps for one in env.envs] == [0, 0] + [4] * (N - 2)
    assert env.render()[0].shape == (360 + 44, 480 + 360, 3)
    env.close()


def test_a_window_shows_one_environment_only():
    with pytest.raises(InputError, match="make_vec: render_mode: expected 'rgb_array' or None: a window shows one"):
        make_vec("vssm_gym/PointNav-v0", render_mode="human")


@pytest.mark.parametrize(
    ("break_it", "field"),
    [
        (lambda: make_vec("vssm_gym/PointNav-v0", num_envs=0), "num_envs"),
        (lambda: make_vec("vssm_gym/PointNav-v0", scene=[]), "scene"),
        (lambda: make_vec("vssm_gym/PointNav-v0", max_episode_steps=0), "max_episode_steps"),
        (lambda: make_vec("vssm_gym/PointNav-v0", threads="2"), "threads"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(seed=[1, 2]), "seed"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(options={"reset_mask": np.zeros(N, bool)}), "reset_mask"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(seed=-1), "seed"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(seed=1.5), "seed"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(seed=[1, -1, 2]), "seed"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(seed="1"), "seed"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(options=5), "options"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(options={"reset_mask": [1, 0]}), "reset_mask"),
    ],
)
def test_bad_input_is_named(break_it, field):
    with pytest.raises(InputError, match=field):
        break_it()


def test_closed_environments_are_not_stepped():
    env = make_vec("vssm_gym/LidarMaze-v0")
    env.reset(seed=0)
    env.close()
    for use in (env.reset, lambda: env.step(env.action_space.sample())):
        with pytest.raises(gym.error.ClosedEnvironmentError):
            use()
