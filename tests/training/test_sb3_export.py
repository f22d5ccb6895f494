"""Test the export of stable-baselines3's policies: commands are those of predict; what does not fit is refused."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")

import stable_baselines3 as sb3
from stable_baselines3.common.vec_env import DummyVecEnv, VecExtractDictObs, VecFrameStack, VecMonitor, VecNormalize
from torch import nn

from tests.helpers.box_rooms import two_rooms
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.features import features, size_of
from vssm_gym.agents.registry import make_agent
from vssm_gym.envs.conventions.actions import from_unit
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.training.environment import BODY
from vssm_gym.training.sb3 import RGBDExtractor, export_sb3
from vssm_gym.training.sb3.vec_env import SB3VecEnv

UNIT = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
METRIC = gym.spaces.Box(np.array([*BODY.low, 0.0], np.float32), np.array([*BODY.high, 1.0], np.float32))
LENGTHS = {
    "goal": gym.spaces.Box(np.array([0.0, -1.0, -1.0], np.float32), np.array([30.0, 1.0, 1.0], np.float32)),
    "pose": gym.spaces.Box(-10.0, 10.0, (3,), np.float32),
    "scan": gym.spaces.Box(0.0, 6.0, (64,), np.float32),
}
PARTS = ("scan", "goal", "pose")
SMALL = {"n_steps": 8, "batch_size": 8, "device": "cpu", "seed": 0}
OFF_POLICY = {"buffer_size": 64, "device": "cpu", "seed": 0}


class Noise(gym.Env):
    """Observe random numbers of a space; actions do nothing."""

    def __init__(self, observation_space, action_space, parts=None):
        self.observation_space, self.action_space = observation_space, action_space
        if parts:
            self.parts = parts

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def named(actions=METRIC, **spaces):
    """Return an environment that observes a Dict, in metres; a space of None is left out."""
    chosen = {name: space for name, space in (LENGTHS | spaces).items() if space is not None}
    return DummyVecEnv([lambda: Noise(gym.spaces.Dict(chosen), actions)])


def vectors(actions=UNIT):
    """Return an environment that observes the features of PARTS."""
    space = gym.spaces.Box(-1.0, 1.0, (size_of(PARTS),), np.float32)
    return DummyVecEnv([lambda: Noise(space, actions, PARTS)])


def normalised(env, **options):
    """Return an environment whose statistics come from some steps; its bound binds now and then."""
    env = VecNormalize(env, clip_obs=1.2, **options)
    env.reset()
    for _ in range(20):
        env.step(np.zeros((1, *env.action_space.shape)))
    env.training = False
    return env


def spread(model):
    """Give all weights of a model the size of 1, so that its actions go beyond their bounds, too."""
    for parameter in model.policy.parameters():
        nn.init.normal_(parameter, std=0.3)
    return model


def ppo(env, policy="MultiInputPolicy", **keywords):
    return spread(sb3.PPO(policy, env, **(SMALL | keywords)))


def off_policy(kind, env, policy="MultiInputPolicy"):
    return spread(kind(policy, env, policy_kwargs={"net_arch": [32, 16]}, **OFF_POLICY))


MODELS = {
    "ppo, Dict in metres": lambda: ppo(named()),
    "ppo, without pose, ReLU": lambda: ppo(
        named(pose=None), policy_kwargs={"activation_fn": nn.ReLU, "net_arch": {"pi": [20], "vf": [8, 8]}}
    ),
    "ppo, actions in [-1, 1]": lambda: ppo(named(UNIT)),
    "ppo, no hidden layer": lambda: ppo(named(), policy_kwargs={"net_arch": []}),
    "ppo, normalised": lambda: ppo(VecMonitor(normalised(named()))),
    "ppo, some normalised": lambda: ppo(normalised(named(), norm_obs_keys=["goal", "scan"])),
    "ppo, rewards normalised": lambda: ppo(normalised(named(), norm_obs=False)),
    "ppo, features": lambda: ppo(vectors(), "MlpPolicy"),
    "ppo, features normalised": lambda: ppo(normalised(vectors()), "MlpPolicy"),
    "a2c": lambda: spread(sb3.A2C("MultiInputPolicy", named(), device="cpu", seed=0)),
    "sac": lambda: off_policy(sb3.SAC, named()),
    "sac, features": lambda: off_policy(sb3.SAC, vectors(), "MlpPolicy"),
    "td3, normalised": lambda: off_policy(sb3.TD3, normalised(named(UNIT))),
    "ddpg": lambda: off_policy(sb3.DDPG, named()),
}


def command_of(model, observation):
    """Return (turn, o, s) that the environment makes of predict's action, as the training saw the observation."""
    norm = model.get_vec_normalize_env()
    seen = observation if norm is None else norm.normalize_obs(observation)
    action, _ = model.predict(seen, deterministic=True)
    action = np.asarray(action, np.float64)[:, :3]
    return from_unit(action, BODY.low, BODY.high) if model.action_space.shape == (3,) else action


@pytest.mark.parametrize("name", MODELS)
def test_commands_are_those_of_predict(tmp_path, name):
    model = MODELS[name]()
    found = policy_file.load(export_sb3(model, tmp_path / "policy.npz", name="mine"))
    base = model.get_env().unwrapped.envs[0].observation_space
    base.seed(1)
    bounded = 0
    for _ in range(50):
        one = base.sample()
        observation = {key: value[None] for key, value in one.items()} if isinstance(one, dict) else one[None]
        vector = features(observation, found.spec.parts) if isinstance(one, dict) else observation
        expected = command_of(model, observation)
        np.testing.assert_allclose(found(vector), expected, atol=1e-5)
        bounded += int(((expected <= BODY.low + 1e-6) | (expected >= BODY.high - 1e-6)).any())
    assert bounded or model.policy.squash_output
    assert found.spec.trained["algorithm"] == type(model).__name__.lower()
    assert found.spec.max_depth == (6.0 if isinstance(base, gym.spaces.Dict) else BODY.max_depth)
    assert make_agent(f"policy:{tmp_path / 'policy.npz'}").name == "mine"


def test_stacked_features_are_the_last_ones_oldest_first(tmp_path):
    env = VecFrameStack(vectors(), 3)
    model = ppo(env, "MlpPolicy")
    found = policy_file.load(export_sb3(model, tmp_path / "policy.npz", name="mine"))
    assert found.spec.frames == 3
    env.seed(3)
    seen = env.reset()
    frames = [seen[0, -size_of(PARTS) :]]
    for _ in range(4):
        stacked = np.concatenate([np.zeros(size_of(PARTS))] * (3 - len(frames)) + frames[-3:])
        np.testing.assert_allclose(found(stacked[None].astype(np.float32)), command_of(model, seen), atol=1e-5)
        seen, *_ = env.step(np.zeros((1, 3)))
        frames.append(seen[0, -size_of(PARTS) :])


REFUSED = {
    "image": (lambda: named(depth=gym.spaces.Box(0.0, 9.0, (24, 32), np.float32)), {}, "observation: expected goal"),
    "size": (lambda: named(scan=gym.spaces.Box(0.0, 8.0, (32,), np.float32)), {}, "found 'scan' of shape"),
    "goal": (lambda: named(goal=None), {}, "observation: expected a goal"),
    "robot": (lambda: named(gym.spaces.Box(-2.0, 2.0, (3,))), {}, "actions: expected bounds of -1 and 1"),
    "discrete": (lambda: named(gym.spaces.Discrete(4)), {}, r"actions: expected \(turn, o, s\)"),
    "car": (lambda: named(gym.spaces.Box(-1.0, 1.0, (2,))), {}, r"actions: expected \(turn, o, s\)"),
    "activation": (named, {"policy_kwargs": {"activation_fn": nn.ELU}}, "policy: expected layers with Tanh or ReLU"),
    "sde": (named, {"use_sde": True}, "policy: expected one without state-dependent"),
    "wrapper": (lambda: VecExtractDictObs(named(), "scan"), {"policy": "MlpPolicy"}, "env: expected VecMonitor"),
    "stack": (lambda: VecFrameStack(named(), 2), {}, "env: expected VecFrameStack on the features"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_file_cannot_express_is_refused(tmp_path, name):
    make, keywords, message = REFUSED[name]
    model = sb3.PPO(env=make(), **({"policy": "MultiInputPolicy"} | SMALL | keywords))
    with pytest.raises(InputError, match=message):
        export_sb3(model, tmp_path / "policy.npz", name="mine")
    assert not (tmp_path / "policy.npz").exists()


def test_other_policies_features_and_files_are_refused(tmp_path):
    plain = sb3.PPO("MlpPolicy", DummyVecEnv([lambda: Noise(LENGTHS["scan"], UNIT)]), **SMALL)
    with pytest.raises(InputError, match="observation: expected a Dict of named parts"):
        export_sb3(plain, tmp_path / "policy.npz", name="mine")
    discrete = sb3.DQN("MultiInputPolicy", named(gym.spaces.Discrete(4)), buffer_size=8)
    with pytest.raises(InputError, match="policy: expected PPO, A2C, SAC"):
        export_sb3(discrete, tmp_path / "policy.npz", name="mine")
    depth = {"depth": gym.spaces.Box(0.0, 9.0, (24, 32), np.float32), "scan": None, "pose": None}
    images = sb3.PPO(
        "MultiInputPolicy", named(**depth), policy_kwargs={"features_extractor_class": RGBDExtractor}, **SMALL
    )
    with pytest.raises(InputError, match="found RGBDExtractor"):
        export_sb3(images, tmp_path / "policy.npz", name="mine", env=named())
    model = ppo(named())
    with pytest.raises(InputError, match=r"a name that ends in \.npz"):
        export_sb3(model, tmp_path / "policy.zip", name="mine")
    model.save(tmp_path / "model.zip")
    with pytest.raises(InputError, match="env: expected the environment of the training"):
        export_sb3(sb3.PPO.load(tmp_path / "model.zip"), tmp_path / "policy.npz", name="mine")
    with pytest.raises(InputError, match="policy: expected 67 inputs"):
        export_sb3(model, tmp_path / "policy.npz", name="mine", env=named(pose=None))

    loaded = export_sb3(sb3.PPO.load(tmp_path / "model.zip"), tmp_path / "a.npz", name="mine", env=named())
    assert loaded.read_bytes() == export_sb3(model, tmp_path / "b.npz", name="mine").read_bytes()


@pytest.mark.slow
def test_the_observations_are_those_of_the_environments():
    """WorldModelNav, and PointNav in its wrappers, observe what a file can express, and take its commands."""
    from vssm_gym.training.sb3.export import _driving, _parts

    env = SB3VecEnv(gym.make_vec("vssm_gym/WorldModelNav-v0", map="oak", num_envs=2, end_on="reach"))
    assert _parts(env) == ("observed_goal", "observed_pose", "observed_scan")
    layer = nn.Linear(5, 4)
    weight, _ = _driving([layer], env.action_space, "clip")[0]
    scale = 2.0 / (BODY.high - BODY.low)
    np.testing.assert_allclose(weight, scale[:, None] * layer.weight.detach().numpy()[:3], rtol=1e-5)
    env.close()


@pytest.mark.slow
def test_a_sweep_runs_an_exported_policy(tmp_path):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    export_sb3(ppo(normalised(named())), tmp_path / "policy.npz", name="mine")
    config = SweepConfig.model_validate(
        {"scenes": str(tmp_path / "rooms.json"), "agents": f"policy:{tmp_path / 'policy.npz'}", "tasks": 1}
    )
    (row,) = read_rows(run_sweep(config, tmp_path / "out", workers=1))
    assert row["agent"].startswith("mine@") and row["steps"] > 0
