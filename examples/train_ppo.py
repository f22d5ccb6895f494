"""Train a policy from depth images with stable-baselines3's PPO, in the simulator.

    pip install "vssm-gym[rl]"
    python examples/train_ppo.py [MINUTES]      # 10 by default; the fewer, the less is learned

``PointNavGPS-v0`` is PointNav with the conventions that policies need: see docs/envs/pointnav.md.
"""

import sys
import time

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.training.sb3 import SB3VecEnv

MINUTES = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0


class Deadline(BaseCallback):
    """End the training after so many minutes, and print the success of the last hundred episodes meanwhile."""

    def _on_training_start(self) -> None:
        self.ends = time.perf_counter() + 60.0 * MINUTES

    def _on_rollout_end(self) -> None:
        ended = list(self.model.ep_info_buffer)
        success = sum(bool(episode["success"]) for episode in ended) / max(len(ended), 1)
        print(f"{self.num_timesteps:,} steps: {success:.0%} success in the last {len(ended)} episodes")

    def _on_step(self) -> bool:
        return time.perf_counter() < self.ends


env = gym.make_vec("vssm_gym/PointNavGPS-v0", num_envs=16, scene="fern")
env = VecMonitor(SB3VecEnv(env), info_keywords=("success", "spl"))
model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=256, ent_coef=0.002, seed=0)
model.learn(10_000_000, callback=Deadline())
model.save("ppo_pointnav.zip")
