"""The native vector environment does what its environments do alone, and restarts episodes as Gymnasium says."""

import gymnasium as gym
import numpy as np
import pytest
from box_rooms import furniture, two_rooms
from gymnasium.vector import AutoresetMode

import vssm_gym  # noqa: F401  (registers the ids)
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError

SCENE = two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))
KEYWORDS = {"scene": SCENE, "camera": CameraConfig(width=32, height=24)}
APARTMENTS = [name for name, (module, *_) in ENVIRONMENTS.items() if module in ("pointnav", "imagenav", "explore")]
N = 3


def make_vec(name: str, num_envs: int = N, **keywords) -> gym.vector.VectorEnv:
    return gym.make_vec(name, num_envs=num_envs, **KEYWORDS | keywords)


def random_actions(env: gym.vector.VectorEnv, rng: np.random.Generator, stops: bool = False) -> np.ndarray:
    low, high = env.action_space.low, env.action_space.high
    actions = rng.uniform(low, high).astype(np.float32)
    actions[:, -1] *= 1.0 if stops else 0.0
    return actions


def same(a: dict, b: dict) -> None:
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


@pytest.mark.parametrize("name", APARTMENTS)
@pytest.mark.parametrize("threads", [1, 2])
def test_it_does_what_the_same_environments_do_one_by_one(name, threads):
    """Gymnasium's own vectorisation of single environments is the oracle, over episodes that end and restart."""
    keywords = {"noise": "high", "sensor_noise": "kinect", "max_episode_steps": 4}
    ours = make_vec(name, threads=threads, **keywords)
    oracle = make_vec(name, vectorization_mode="sync", threads=1, **keywords)
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
        np.testing.assert_array_equal(ours_now[4]["T_world_cam"], oracle_now[4]["T_world_cam"])
        restarts += int("start_pose" in ours_now[4])
    assert restarts > 2
    ours.close()
    oracle.close()


def test_observations_are_the_callers_own():
    env = make_vec("vssm_gym/PointNav-v0")
    first, _ = env.reset(seed=0)
    kept = {key: value.copy() for key, value in first.items()}
    env.step(random_actions(env, np.random.default_rng(0)))
    same(first, kept)
    env.close()


def test_some_environments_may_be_reset_alone():
    env = make_vec("vssm_gym/PointNav-v0", max_episode_steps=5)
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(2):
        before = env.step(random_actions(env, rng))[0]
    observation, infos = env.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(infos["_start_pose"], [False, True, False])
    for i, kept in enumerate([True, False, True]):
        assert (observation["rgb"][i] == before["rgb"][i]).all() == kept
    truncated = np.array([env.step(random_actions(env, rng))[3] for _ in range(4)])
    np.testing.assert_array_equal(truncated.argmax(axis=0), [2, 0, 2])  # the one reset alone has two steps more
    np.testing.assert_array_equal(truncated[3], [False, False, False])
    env.close()


def test_environments_take_a_list_of_scenes_in_turn():
    env = make_vec("vssm_gym/PointNav-v0", scene=[SCENE, "oak"])
    assert [one.apartment.name for one in env.unwrapped.envs] == ["two_rooms", "oak", "two_rooms"]
    one, other, third = env.unwrapped.envs
    assert one.simulation.stage is third.simulation.stage is not other.simulation.stage
    assert one.simulation.scenery is third.simulation.scenery
    env.close()


def test_pictures_of_all_can_be_had():
    env = make_vec("vssm_gym/PointNav-v0", render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == N and pictures[0].shape == (360, 480 + 360, 3)
    env.close()


@pytest.mark.parametrize(
    ("break_it", "field"),
    [
        (lambda: make_vec("vssm_gym/PointNav-v0", num_envs=0), "num_envs"),
        (lambda: make_vec("vssm_gym/PointNav-v0", scene=[]), "scene"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(seed=[1, 2]), "seed"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(options={"reset_mask": np.zeros(N, bool)}), "reset_mask"),
        (lambda: make_vec("vssm_gym/PointNav-v0").reset(options={"reset_mask": [1, 0]}), "reset_mask"),
    ],
)
def test_bad_input_is_named(break_it, field):
    with pytest.raises(InputError, match=field):
        break_it()
