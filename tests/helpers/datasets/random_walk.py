"""Write a small recording of random images."""

import numpy as np

from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.geometry.camera import Camera

FRAMES = 7


def record(folder, controls=True):
    """Write seven frames of random images; return colours and depths (m), as they were given to the writer."""
    rng = np.random.default_rng(0)
    writer = SequenceWriter(folder, Camera(40, 36, 30.0, 30.0, 20.0, 18.0), np.eye(4), controls=controls)
    colours = rng.integers(0, 256, (FRAMES, 36, 40, 3), dtype=np.uint8)
    depths = rng.uniform(0.3, 12.0, (FRAMES, 36, 40))
    for i in range(FRAMES):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i
        control = np.array([0.1 * i, 0.0, 0.2]) if controls and i else None
        writer.append(0.1 * i, colours[i], depths[i], pose, control)
    writer.close()
    return colours, depths
