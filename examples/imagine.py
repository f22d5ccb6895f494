"""Drive 256 robots at once inside a learned map, without a simulator.

    python examples/imagine.py

The policy has 30,000 parameters and was trained in this map for twelve minutes; both come with the package.
"""

import time

import gymnasium as gym
import numpy as np
from PIL import Image

import vssm_gym
from vssm_gym.agents.policy import features, policy_file

policy = policy_file.load("oak")
env = gym.make_vec(
    "vssm_gym/WorldModelNav-v0", map="oak", num_envs=256, noise="mid", end_on="reach", render_mode="rgb_array"
)
observations, infos = env.reset(seed=0)
env.step(np.zeros((env.num_envs, 4), np.float32))  # compiled here, or read from the cache

ended, arrived, began = 0, 0, time.perf_counter()
for _ in range(200):
    commands = policy(features.features(observations, policy.spec.parts))  # turn (rad), direction (rad), step (m)
    stop = np.zeros((env.num_envs, 1), np.float32)
    observations, rewards, terminated, truncated, infos = env.step(np.hstack([commands, stop]).astype(np.float32))
    ended, arrived = ended + (terminated | truncated).sum(), arrived + terminated.sum()
seconds = time.perf_counter() - began

print(f"vssm_gym {vssm_gym.__version__}: {200 * env.num_envs / seconds:,.0f} imagined steps a second")
print(f"{ended} episodes, {arrived / max(ended, 1):.0%} of them arrived")
Image.fromarray(env.render()[0]).save("imagine.png")
print("imagine.png: one of the robots on the map's floor plan")
