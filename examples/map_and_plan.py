"""Make a map of your own RGB-D images with known poses, render it from a new pose, and plan in it.

    python examples/map_and_plan.py

The images come from the simulator here: put your own in place of ``look_around``.
"""

import gymnasium as gym
import numpy as np
from PIL import Image

import vssm_gym as vg


def look_around() -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, vg.Camera]:
    """Return (colour, z-depth in metres) of each image, their poses T_world_cam (n, 4, 4), and the camera."""
    env = gym.make("vssm_gym/PointNav-v0", scene="oak", noise="none", camera={"width": 80, "height": 60})
    image, info = env.reset(seed=10)
    frames, poses = [], []
    for _ in range(32):  # once around itself
        frames.append((image["rgb"], image["depth"]))
        poses.append(info["T_world_cam"])
        image, *_, info = env.step(np.array([0.2, 0.0, 0.0, 0.0], np.float32))
    return frames, np.array(poses), vg.Camera.from_matrix(info["K"], width=80, height=60)


frames, T_world_cam, camera = look_around()
m = vg.map_from_frames(frames, T_world_cam, camera, voxel=0.07)
m.save("room.npz")

above = T_world_cam[0].copy()
above[2, 3] += 0.4  # where the camera never was
image = vg.render(m, above, camera.resized(320, 240))
Image.fromarray(np.asarray(255 * image.rgb).astype(np.uint8)).save("room.png")

floor = vg.ClearanceMap.from_voxel_map(m)  # distance to the nearest obstacle, m
start = T_world_cam[0, :2, 3]
ahead = T_world_cam[0, :2, 2]  # the camera's z axis
for metres in (1.5, 1.0, 0.5):
    found = vg.plan(start, start + metres * ahead, floor, radius=0.2)
    if found.found:
        print(f"a path of {found.cost:.2f} m to {metres} m ahead, {len(found.path)} waypoints")
        break
print("room.npz, room.png")
