"""Drive 256 robots at once inside a learned map, without a simulator, and draw their paths.

    python examples/imagine.py

The policy has 30,000 parameters and was trained in this map for twelve minutes; both come with the package.
"""

import time

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import vssm_gym as vg

agent = vg.make_agent("policy:oak")
env = gym.make_vec("vssm_gym/WorldModelNav-v0", map="oak", num_envs=256, noise="mid", end_on="reach")
observations, infos = env.reset(seed=0)
env.step(np.zeros((env.num_envs, 4), np.float32))  # compiled here, or read from the cache

ended, arrived, places, began = 0, 0, [env.unwrapped.planar[:, :2]], time.perf_counter()
for _ in range(200):
    commands = agent.commands(observations)  # turn (rad), direction (rad), step (m)
    stop = np.zeros((env.num_envs, 1), np.float32)
    observations, rewards, terminated, truncated, infos = env.step(np.hstack([commands, stop]).astype(np.float32))
    ended, arrived = ended + (terminated | truncated).sum(), arrived + terminated.sum()
    places.append(env.unwrapped.planar[:, :2])
seconds = time.perf_counter() - began

print(f"vssm_gym {vg.__version__}: {200 * env.num_envs / seconds:,.0f} imagined steps a second")
print(f"{ended} episodes, {arrived / max(ended, 1):.0%} of them arrived")

floor = vg.ClearanceMap.from_voxel_map(vg.VoxelMap.load("oak"))  # distance to the nearest obstacle, m
low = floor.origin - 0.5 * floor.resolution
high = low + floor.resolution * np.array(floor.clearance.shape)
paths = np.array(places)
paths[1:][np.linalg.norm(np.diff(paths, axis=0), axis=2) > 0.5] = np.nan  # a new episode begins elsewhere
figure, axes = plt.subplots(figsize=(8, 6.5), layout="constrained")
axes.imshow(floor.clearance.T > 0.0, cmap="gray", origin="lower", extent=(low[0], high[0], low[1], high[1]))
axes.plot(paths[..., 0], paths[..., 1], color="tab:red", linewidth=0.4, alpha=0.6)
axes.set(xlabel="x, m", ylabel="y, m")
figure.savefig("imagine.png", dpi=120)
print("imagine.png: the paths of all robots on the map's floor plan")
