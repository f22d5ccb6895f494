"""Test observation wrappers: their laws, Gymnasium's checks, and the agreement of vector and single versions."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vssm_gym.envs import vector_wrappers, wrappers
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError

ID = "vssm_gym/PointNav-v0"
NAMES = ("DepthOnly", "NormalizedDepth", "RelativeGoal")
SMALL = CameraConfig(16, 12)


def make(**keywords) -> gym.Env:
    return gym.make(ID, scene="oak", camera=SMALL, **keywords)


def make_many(n: int, mode: str = "NextStep", **keywords) -> gym.vector.SyncVectorEnv:
    return gym.vector.SyncVectorEnv([lambda: make(**keywords)] * n, autoreset_mode=gym.vector.AutoresetMode(mode))


@pytest.mark.parametrize("observe_pose", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_a_wrapped_environment_passes_gymnasiums_check(name, observe_pose):
    env = getattr(wrappers, name)(make(observe_pose=observe_pose).unwrapped)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(render modes|not wrapped|different from the unwrapped).*")
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("name", NAMES)
def test_a_wrapped_environment_is_remade_from_its_spec(name):
    env = getattr(wrappers, name)(make())
    spec = pickle.loads(pickle.dumps(env.spec))
    again = gym.make(spec)
    assert type(again) is type(env)
    assert again.observation_space == env.observation_space
    first, second = env.reset(seed=3)[0], again.reset(seed=3)[0]
    assert first.keys() == second.keys()
    for key in first:
        np.testing.assert_array_equal(first[key], second[key])


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
@pytest.mark.parametrize("name", NAMES)
def test_the_vector_version_is_the_single_one_side_by_side(name, mode):
    """They agree across ends of episodes: environment 1 stops in step 2 and restarts in the next one."""
    vector = getattr(vector_wrappers, name)(make_many(2, mode, max_episode_steps=50))
    single = [getattr(wrappers, name)(make(max_episode_steps=50)) for _ in range(2)]
    rng = np.random.default_rng(0)
    expected = [env.reset(seed=7 + i)[0] for i, env in enumerate(single)]
    found, _ = vector.reset(seed=7)
    over = np.zeros(2, bool)
    for step in range(6):
        for i, one in enumerate(expected):
            assert vector.single_observation_space.contains(one)
            for key in one:
                np.testing.assert_array_equal(found[key][i], one[key])
        if mode == "Disabled" and over.any():
            found, _ = vector.reset(options={"reset_mask": over})
            expected = [env.reset()[0] if over[i] else expected[i] for i, env in enumerate(single)]
            over[:] = False
            continue
        actions = rng.uniform(vector.single_action_space.low, vector.single_action_space.high, (2, 4))
        actions = actions.astype(np.float32)
        actions[:, 3] = [0.0, float(step == 2)]
        found, _, terminated, _, _ = vector.step(actions)
        expected = [env.reset()[0] if over[i] else env.step(actions[i])[0] for i, env in enumerate(single)]
        over = terminated
    vector.close()


@given(arrays(np.float32, (2, 3, 4), elements=st.floats(0.0, 1000.0, width=32)), st.floats(0.5, 100.0))
def test_normalized_depth_keeps_no_reading_apart(depth, max_depth):
    observation = {"depth": depth, "goal": np.zeros(2, np.float32)}
    found = wrappers.normalized_depth(observation, max_depth)["depth"]
    assert found.dtype == np.float32
    assert (found <= 1.0).all()
    readings = depth > 1e-3  # nearer than any camera measures, a division could vanish
    assert (found[readings] > 0.0).all()
    assert (found[depth == 0.0] == 0.0).all()
    within = depth < max_depth
    np.testing.assert_allclose(found[within] * max_depth, depth[within], rtol=1e-5, atol=1e-30)
    assert observation["depth"] is depth  # the environment's own is left alone


def test_relative_goal_by_hand():
    """At (1, 2) looking along +y, the goal at (1, 5) lies 3 m ahead and one at (4, 2) 3 m to the right."""
    pose = np.array([1.0, 2.0, np.pi / 2])
    for goal, expected in (((1.0, 5.0), (3.0, 1.0, 0.0)), ((4.0, 2.0), (3.0, 0.0, -1.0))):
        found = wrappers.relative_goal({"goal": np.array(goal, np.float32)}, pose)["goal"]
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("noise", ["none", "high"])
def test_relative_goal_never_uses_the_true_pose(noise):
    """Without noise and contacts reckoning is exact; with noise it errs, unless the pose is observed."""
    blind, seeing = (wrappers.RelativeGoal(make(noise=noise, observe_pose=p)) for p in (False, True))
    (a, info), (b, _) = blind.reset(seed=5), seeing.reset(seed=5)
    np.testing.assert_allclose(a["goal"], b["goal"], atol=1e-5)
    collided = False
    for _ in range(12):
        a, _, _, _, info = blind.step(np.array([0.1, 0.02, 0.05, 0.0], np.float32))
        b, *_ = seeing.step(np.array([0.1, 0.02, 0.05, 0.0], np.float32))
        collided |= info["collision"]
    assert not collided
    off = np.abs(a["goal"] - b["goal"]).max()
    assert off < 2e-3 if noise == "none" else off > 0.02


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda: wrappers.NormalizedDepth(make(), max_depth=0.0), "NormalizedDepth: max_depth: expected a positive"),
        (lambda: wrappers.NormalizedDepth(make(), max_depth=float("nan")), "NormalizedDepth: max_depth"),
        (lambda: wrappers.DepthOnly(gym.make("CartPole-v1")), "DepthOnly: env: expected an environment that observes"),
        (lambda: wrappers.RelativeGoal(wrappers.RelativeGoal(make())), "RelativeGoal: goal: expected a point"),
        (lambda: vector_wrappers.RelativeGoal(make_many(1, "SameStep")), "one that resets in the next step"),
    ],
)
def test_an_unsuitable_environment_is_refused(wrap, message):
    with pytest.raises(InputError) as refused:
        wrap()
    assert message in str(refused.value)
