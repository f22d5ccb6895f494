"""Test the vector adapter against stable-baselines3's own, the feature extractor, and the training of a policy."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from vssm_gym.envs import vector_wrappers, wrappers
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.training.sb3 import RGBDExtractor, SB3VecEnv

ID = "vssm_gym/PointNav-v0"
MODES = [gym.vector.AutoresetMode.NEXT_STEP, gym.vector.AutoresetMode.DISABLED]


class Counter(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """Observe (episode, step, sum of its actions); episode ``e`` ends after ``2 + (e + first) % 3`` steps.

    Episodes end in turn terminated, truncated, and both at once. The reward is the step's number.
    """

    observation_space = gym.spaces.Dict({"count": gym.spaces.Box(-1e6, 1e6, (3,), np.float32)})
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, first: int) -> None:
        self.first, self.episode, self.count, self.total = first, -1, 0, 0.0

    def _observe(self) -> dict[str, np.ndarray]:
        return {"count": np.array([self.episode, self.count, self.total], np.float32)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.episode, self.count, self.total = self.episode + 1, 0, 0.0
        return self._observe(), {"start": self.episode, "draw": float(self.np_random.uniform())}

    def step(self, action: np.ndarray):
        self.count, self.total = self.count + 1, self.total + float(action[0])
        over = self.count == 2 + (self.episode + self.first) % 3
        terminated, truncated = over and self.episode % 3 != 1, over and self.episode % 3 != 0
        info: dict[str, Any] = {"twice": {"count": 2 * self.count}}
        if over:
            info["success"] = self.episode % 2 == 0
        return self._observe(), float(self.count), terminated, truncated, info


def counters(mode: gym.vector.AutoresetMode = gym.vector.AutoresetMode.NEXT_STEP, n: int = 3) -> SB3VecEnv:
    makers = [lambda i=i: Counter(i) for i in range(n)]
    return SB3VecEnv(gym.vector.SyncVectorEnv(makers, autoreset_mode=mode))


def same(a: Any, b: Any) -> bool:
    """Return True for equal dictionaries of arrays, numbers and dictionaries."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return np.array_equal(a, b)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_every_step_is_that_of_stable_baselines3s_own_vector_environment(mode):
    """Observations, rewards, ends, terminal observations, truncations and infos, over many ends of all kinds."""
    mine, theirs = counters(mode), DummyVecEnv([lambda i=i: Counter(i) for i in range(3)])
    for env in (mine, theirs):
        env.seed(5)
    assert same(mine.reset(), theirs.reset())
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(40):
        actions = rng.uniform(-1.0, 1.0, (3, 1)).astype(np.float32)
        (a, ra, da, ia), (b, rb, db, ib) = mine.step(actions), theirs.step(actions)
        assert same(a, b)
        assert all(same(x, y) for x, y in zip(ia, ib, strict=True))
        np.testing.assert_array_equal(ra, rb)
        np.testing.assert_array_equal(da, db)
        assert all(same(x, y) for x, y in zip(mine.reset_infos, theirs.reset_infos, strict=True))
        assert (ra.dtype, da.dtype) == (rb.dtype, db.dtype)
        kinds |= {(bool(done), info["TimeLimit.truncated"]) for done, info in zip(da, ia, strict=True)}
    assert kinds == {(False, False), (True, False), (True, True)}


def test_an_ending_by_hand():
    """One environment whose episodes last 2, 3, 4, 2, ... steps: terminated, truncated, both, terminated, ..."""
    env = counters(n=1)
    assert env.reset()["count"].tolist() == [[0, 0, 0]]
    seen = []
    for _ in range(9):
        observation, reward, done, (info,) = env.step(np.full((1, 1), 0.5, np.float32))
        last = info["terminal_observation"]["count"].tolist() if done[0] else None
        seen.append((observation["count"][0].tolist(), reward[0], last, info["TimeLimit.truncated"]))
    assert seen == [
        ([0, 1, 0.5], 1, None, False),
        ([1, 0, 0], 2, [0, 2, 1], False),  # the new episode's first observation, the old one's reward
        ([1, 1, 0.5], 1, None, False),  # no step is lost on the reset
        ([1, 2, 1], 2, None, False),
        ([2, 0, 0], 3, [1, 3, 1.5], True),
        ([2, 1, 0.5], 1, None, False),
        ([2, 2, 1], 2, None, False),
        ([2, 3, 1.5], 3, None, False),
        ([3, 0, 0], 4, [2, 4, 2], False),  # terminated and truncated: nothing was cut off
    ]


def test_a_terminal_observation_outlives_the_next_steps():
    """A terminal observation is a copy, although the environment writes all observations into the same memory."""
    env = SB3VecEnv(gym.vector.SyncVectorEnv([lambda: Counter(0)], copy=False))
    env.reset()
    env.step(np.zeros((1, 1), np.float32))
    *_, (info,) = env.step(np.zeros((1, 1), np.float32))
    env.step(np.zeros((1, 1), np.float32))
    assert info["terminal_observation"]["count"].tolist() == [0, 2, 0]


@pytest.mark.slow
def test_worker_processes_agree_too():
    """Worker processes with shared memory, spawned as the package's own, give the same steps."""
    makers = [lambda i=i: Counter(i) for i in range(2)]
    mine = SB3VecEnv(gym.vector.AsyncVectorEnv(makers, context="spawn"))
    theirs = DummyVecEnv(makers)
    for env in (mine, theirs):
        env.seed(3)
    assert same(mine.reset(), theirs.reset())
    for _ in range(12):
        actions = np.full((2, 1), 0.25, np.float32)
        (a, _, da, ia), (b, _, db, ib) = mine.step(actions), theirs.step(actions)
        assert same(a, b)
        assert same(da, db)
        assert all(same(x, y) for x, y in zip(ia, ib, strict=True))
    mine.close()


def test_attributes_and_methods():
    env = counters()
    assert env.get_attr("render_mode") == [None] * 3
    assert env.get_attr("first") == [0, 1, 2]
    assert env.get_attr("first", indices=[1]) == [1]
    assert not env.has_attr("last")
    env.set_attr("first", [5, 6, 7])
    assert env.get_attr("first") == [5, 6, 7]
    assert env.env_method("has_wrapper_attr", "first") == [True] * 3
    assert env.env_is_wrapped(gym.Wrapper, 0) == [False]
    with pytest.raises(InputError, match="all environments"):
        env.set_attr("first", 1, indices=[0])


def test_attributes_and_methods_of_the_native_vector_environment():
    env = SB3VecEnv(gym.make_vec(ID, num_envs=2, camera={"width": 32, "height": 24}))
    env.reset()
    assert env.get_attr("success_radius") == [0.4, 0.4]
    env.set_attr("mark", 3)
    assert env.get_attr("mark", indices=[1]) == [3]
    assert [len(report) for report in env.env_method("report")] == [5, 5]
    env.close()


def test_same_step_autoreset_is_refused():
    with pytest.raises(InputError, match="one that resets in the next step"):
        counters(gym.vector.AutoresetMode.SAME_STEP)


def space(**parts: tuple[int, ...]) -> gym.spaces.Dict:
    rgb = {"rgb": gym.spaces.Box(0, 255, parts.pop("rgb"), np.uint8)} if "rgb" in parts else {}
    return gym.spaces.Dict(rgb | {key: gym.spaces.Box(-1e3, 1e3, shape) for key, shape in parts.items()})


def test_the_extractors_input_by_hand():
    """No reading is (0, 0), a near wall (small, 1), everything beyond max_depth (1, 1)."""
    extractor = RGBDExtractor(space(rgb=(3, 8, 8), depth=(8, 8), goal=(2,), pose=(3,)), 16, max_depth=4.0)
    depth = torch.zeros(1, 8, 8)
    depth[0, 0, :3] = torch.tensor([1.0, 4.0, 9.0])
    observation = {"rgb": torch.full((1, 3, 8, 8), 0.5), "depth": depth}
    observation |= {"goal": torch.tensor([[5.0, -20.0]]), "pose": torch.tensor([[1.0, 2.0, np.pi / 2]])}
    image = extractor.image(observation)
    assert image.shape == (1, 5, 8, 8)
    assert image[0, 3:, 0, :4].T.tolist() == [[0.25, 1], [1, 1], [1, 1], [0, 0]]
    np.testing.assert_allclose(extractor.numbers(observation), [[0.5, -2.0, 0.1, 0.2, 0.0, 1.0]], atol=1e-6)
    assert extractor(observation).shape == (1, 16)
    relative = {"goal": torch.tensor([[5.0, 0.6, -0.8]])}
    np.testing.assert_allclose(extractor.numbers(relative), [[0.5, 0.6, -0.8]])


@pytest.mark.parametrize("size", [(8, 8), (24, 32), (120, 160)])
@pytest.mark.parametrize("parts", [{"rgb", "depth", "goal"}, {"depth", "goal", "pose"}, {"depth"}, {"rgb", "depth"}])
def test_the_extractor_takes_any_size_and_all_its_parts_matter(size, parts):
    shapes = {"rgb": (3, *size), "depth": size, "goal": (2,), "pose": (3,)}
    extractor = RGBDExtractor(space(**{key: shapes[key] for key in parts}), 32)
    torch.manual_seed(0)
    observation = {key: torch.rand(2, *shapes[key], requires_grad=True) for key in parts}
    features = extractor(observation)
    assert features.shape == (2, 32)
    features.sum().backward()
    for key, value in observation.items():
        assert value.grad is not None
        assert value.grad.abs().sum() > 0.0, key


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"goal": (2,)}, "RGBDExtractor: depth: expected an image"),
        ({"depth": (8, 8), "rgb": (8, 8, 3)}, "RGBDExtractor: rgb: expected channels first"),
        ({"depth": (8, 8), "smell": (3,)}, "found ['smell'] too"),
    ],
)
def test_observations_it_cannot_read_are_refused(parts, message):
    with pytest.raises(InputError) as refused:
        RGBDExtractor(space(**parts))
    assert message in str(refused.value)


@pytest.mark.parametrize("wrap", [lambda env: env, wrappers.DepthOnly, wrappers.NormalizedDepth, wrappers.RelativeGoal])
def test_environments_pass_the_check_of_stable_baselines3(wrap):
    env = wrap(gym.make(ID, camera=CameraConfig(32, 24)))
    check_env(env, warn=False)
    env.close()


def train(env: gym.vector.VectorEnv, steps: int) -> PPO:
    """Train a small PPO as a user would."""
    model = PPO(
        "MultiInputPolicy",
        VecMonitor(SB3VecEnv(env)),
        n_steps=64,
        batch_size=64,
        n_epochs=2,
        policy_kwargs={"features_extractor_class": RGBDExtractor, "features_extractor_kwargs": {"features_dim": 64}},
        seed=0,
        device="cpu",
    )
    return model.learn(steps)


@pytest.mark.slow
def test_ppo_trains_on_pointnav(tmp_path):
    """In 20,000 steps parameters change and stay finite, episodes end, and a loaded policy acts."""
    camera = {"width": 32, "height": 24}
    native = gym.make_vec(ID, num_envs=8, scene="oak", camera=camera, end_on="reach", max_episode_steps=100)
    env = vector_wrappers.RelativeGoal(native)
    model = train(env, 20_000)
    assert model.num_timesteps >= 20_000
    assert len(model.ep_info_buffer) == 100
    assert all(torch.isfinite(parameter).all() for parameter in model.policy.parameters())
    model.save(tmp_path / "policy.zip")
    observation, _ = env.reset(seed=1)
    again = PPO.load(tmp_path / "policy.zip", device="cpu")
    action, _ = again.predict(observation, deterministic=True)
    assert action.shape == (8, 4)
    np.testing.assert_array_equal(action, model.predict(observation, deterministic=True)[0])
