"""Drive an apartment with an agent that plans in a learned map, and write what it did as an animated picture.

    python examples/drive.py [AGENT]    # astar (default), or policy:oak, a trained policy that comes with the package
    python examples/drive.py --help     # more names

The map of ``oak`` comes with the package too, so that nothing is recorded, learned or trained here.
"""

import argparse

import gymnasium as gym
from PIL import Image

import vssm_gym as vg

names = "astar (default), policy:oak, policy:FILE, or another agent of PointNav: astar+theta_star, slam_nav, oracle"
parser = argparse.ArgumentParser(description="Drive an apartment with an agent, and write drive.gif.")
parser.add_argument("agent", nargs="?", default="astar", help=names)
try:
    agent = vg.make_agent(parser.parse_args().agent)
except vg.InputError as error:
    parser.error(f"{error}; or policy:oak")
env = gym.make("vssm_gym/PointNav-v0", scene="oak", noise="mid", render_mode="rgb_array")
observation, info = env.reset(seed=4)
agent.reset(vg.agent_context(env, info, vg.VoxelMap.load("oak")), observation, seed=0)

frames, over = [env.render()], False
while not over:
    decision = agent.act(observation)  # of the images and its own commands; it never gets info
    observation, reward, terminated, truncated, info = env.step(decision.action)
    frames.append(env.render())
    over = terminated or truncated

print(decision.status)
print(f"success {info['success']}, SPL {info['spl']:.2f}, {info['path_length']:.1f} m, {len(frames) - 1} steps")
first, *rest = (Image.fromarray(frame) for frame in frames)
first.save("drive.gif", save_all=True, append_images=rest, duration=200, loop=0)
print("drive.gif")
