"""Train a policy from depth images with stable-baselines3's PPO, in the simulator.

    pip install -c constraints.txt ".[rl]"      # in the checkout
    python examples/train_ppo.py [MINUTES]      # 10 by default; the fewer, the less is learned

``PointNavGPS-v0`` is PointNav with the conventions that policies need: see docs/envs/pointnav.md.
"""

import argparse
import time

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.training.sb3 import SB3VecEnv

parser = argparse.ArgumentParser(description="Train a policy from depth images with PPO, in the simulator.")
parser.add_argument("minutes", nargs="?", type=float, default=10.0, help="10 by default")
MINUTES = parser.parse_args().minutes
ROBOTS, STEPS = 16, 500  # robots at once, and the longest episode
ENOUGH = 100  # episodes that a mean is taken over


class Deadline(BaseCallback):
    """End the training after so many minutes, and print success and SPL of the last hundred episodes meanwhile.

    Quick episodes end first, and most of these succeed. So the means are printed once every robot has had the time for
    the longest episode.
    """

    def _on_training_start(self) -> None:
        self.ends = time.perf_counter() + 60.0 * MINUTES

    def _on_rollout_end(self) -> None:
        ended = list(self.model.ep_info_buffer)
        if len(ended) < ENOUGH or self.num_timesteps < ROBOTS * STEPS:
            needed = f"success needs {ENOUGH} and {ROBOTS * STEPS:,} steps"
            print(f"{self.num_timesteps:,} steps: {len(ended)} episodes ended; {needed}")
        else:
            print(f"{self.num_timesteps:,} steps: {scores(ended)} in the last {len(ended)} episodes")

    def _on_step(self) -> bool:
        return time.perf_counter() < self.ends


def scores(episodes: list[dict]) -> str:
    """Return the mean success and SPL of episodes in words."""
    success, spl = (sum(float(episode[name]) for episode in episodes) / len(episodes) for name in ("success", "spl"))
    return f"{success:.0%} success, SPL {spl:.2f}"


env = gym.make_vec("vssm_gym/PointNavGPS-v0", num_envs=ROBOTS, scene="fern", max_episode_steps=STEPS)
env = VecMonitor(SB3VecEnv(env), info_keywords=("success", "spl"))

env.reset()
first: dict[int, dict] = {}  # the first episode of each robot, whichever way it ends
while len(first) < ROBOTS:
    *_, infos = env.step(np.array([env.action_space.sample() for _ in range(ROBOTS)]))
    first |= {i: info["episode"] for i, info in enumerate(infos) if "episode" in info and i not in first}
print(f"random actions: {scores(list(first.values()))} in {ROBOTS} episodes")

model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=256, ent_coef=0.002, seed=0)
model.learn(10_000_000, callback=Deadline())
model.save("ppo_pointnav.zip")
print('ppo_pointnav.zip; load it with PPO.load("ppo_pointnav.zip")')
