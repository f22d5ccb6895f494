"""Estimate the trajectory of a camera and the map from a stream of RGB-D images, one at a time.

    python examples/slam.py [TUM_FOLDER]

Without a folder a walk is recorded in the simulator first. ``vssm-gym slam FOLDER`` does the same, with a report.
"""

import argparse
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vssm_gym as vg
from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import FrameReader

parser = argparse.ArgumentParser(description="Estimate a camera's trajectory and the map, image by image.")
parser.add_argument("folder", nargs="?", type=Path, help="of TUM's layout; without it a walk is recorded first")
folder = parser.parse_args().folder
if folder is None:
    folder = Path(tempfile.mkdtemp()) / "walk"
    record_handheld("oak", folder, metres=1.0, seed=0)

sequence = vg.load_sequence(folder)
reader = FrameReader(sequence, (80, 60))  # images of this size
body = vg.Rigid()  # a camera in somebody's hand: constant velocity, and noise
prism = vg.make_filter("prism", reader.camera, body)
empty = vg.VoxelMap.cube((0.0, 0.0, 0.0), extent=12.0, voxel_size=0.1)  # around the first camera
prior = vg.Posterior(body.belief_at(np.eye(4)), empty)

state, T_world_cam, times = None, [np.eye(4)], sequence.times
for k in range(0, len(sequence.frames), 2):
    image = vg.RGBD.from_camera(*reader[k])
    if state is None:
        state, before = prism.init(prior, image, jax.random.key(0)), times[k]
        continue
    state, info = prism.step(state, jnp.zeros(body.controls), image, float(times[k] - before))
    before = times[k]
    T_world_cam.append(np.asarray(body.manifold.pose(info.belief.mean)))
    std = np.sqrt(np.diag(info.belief.covariance)[:3])
    print(f"{times[k] - times[0]:6.2f} s  {info.status.message:4}  stds {np.round(100 * std, 1)} cm")

taken = times[::2][: len(T_world_cam)]
vg.write_trajectory("trajectory.txt", taken, np.array(T_world_cam))
prism.posterior(state).save("map.npz")
print("trajectory.txt, map.npz")
