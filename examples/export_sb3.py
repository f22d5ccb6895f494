"""Train a policy by a script of your own with stable-baselines3, export it, and read it back without torch.

    make install                                # in the checkout
    python examples/export_sb3.py [STEPS]       # 2,000,000 by default, about 10 minutes; the fewer, the less is learned

The robots are imagined in the learned map ``oak`` that comes with the package; docs/rl.md says which policies can be
exported. The file is an agent of every sweep of PointNav.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import vssm_gym as vg
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.features import features
from vssm_gym.training.sb3 import SB3VecEnv, export_sb3

parser = argparse.ArgumentParser(description="Train a policy in the learned map oak, export it, and read it back.")
parser.add_argument("steps", nargs="?", type=int, default=2_000_000, help="of all robots together, 2000000 by default")
STEPS = parser.parse_args().steps

worlds = gym.make_vec("vssm_gym/WorldModelNav-v0", map="oak", num_envs=64, noise=("low", "mid"), end_on="reach")
env = VecNormalize(VecMonitor(SB3VecEnv(worlds)), norm_reward=False)
model = PPO("MultiInputPolicy", env, verbose=1, n_steps=64, batch_size=1024, ent_coef=0.002, device="cpu", seed=0)
model.learn(STEPS)
path = export_sb3(model, Path("mine.npz"), name="mine")

env.training = False
policy, observations = policy_file.load(path), worlds.reset(seed=1)[0]
asked, _ = model.predict(env.normalize_obs(observations), deterministic=True)
furthest = np.abs(policy(features(observations, policy.spec.parts)) - asked[:, :3]).max()
print(f"{path}: {path.stat().st_size / 1000:.0f} kB; its commands are those of the model within {furthest:.0e}")

Path("mine.yaml").write_text("scenes: oak\nagents: [astar, 'policy:mine.npz']\ntasks: 20\n")
print(f"{vg.load_config('mine.yaml').agents[1]}")
print("next: vssm-gym sweep mine.yaml --out out/mine; vssm-gym report out/mine")
