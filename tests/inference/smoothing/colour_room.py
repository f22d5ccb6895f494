"""Show a room known in closed form to a depth camera and to a colour camera beside it."""

from functools import cache
from pathlib import Path

import numpy as np

from tests.helpers.analytic_room import camera_pose
from tests.helpers.slam_recordings import CAMERA, ROOM
from vssm_gym.data.intrinsics import ColourCalibration
from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import ColourCamera

FRAMES, DT = 32, 0.5  # and s between two of them
COLOUR = Camera(96, 64, 64.0, 63.0, 47.0, 32.0)  # stated; of another size than depth
STATED = ColourCamera(COLOUR, np.eye(4))
THETA = np.array([0.025, 0.002, -0.003, 0.008, -0.01, 0.012, 0.02, 0.02, 0.0, 0.0])
TRUE = STATED.moved(THETA)


def true_pose(k: int) -> np.ndarray:
    """Return the pose of a hand that turns to both sides, and comes near to a wall and away from it."""
    place = (-0.5 + 0.5 * np.sin(0.25 * k), 0.3 * np.sin(0.4 * k), 1.1 + 0.2 * np.sin(0.3 * k))
    return camera_pose(place, 0.5 * np.sin(0.2 * k), 0.2 + 0.15 * np.sin(0.33 * k), 0.15 * np.sin(0.5 * k))


@cache
def images(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return RGB uint8 of the colour camera and z-depth (m) of the depth camera."""
    seen = ROOM.image(true_pose(k) @ np.asarray(TRUE.T_depth_colour), TRUE.camera)
    return np.rint(255.0 * np.asarray(seen.rgb)).astype(np.uint8), np.asarray(ROOM.image(true_pose(k), CAMERA).depth)


def write_unregistered(folder: Path, frames: int = FRAMES) -> Path:
    """Write a TUM folder of the room, with the stated calibration."""
    writer = SequenceWriter(folder, CAMERA, np.eye(4), controls=False, colour=ColourCalibration(STATED))
    for k in range(frames):
        writer.append(DT * k, *images(k), true_pose(k))
    writer.close()
    return folder
