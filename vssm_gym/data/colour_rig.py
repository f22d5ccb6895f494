"""Draw a colour camera beside the depth camera, and the rough calibration that a maker would state for it.

The true one is 2.5 cm to the left or right, turned by about a degree, and its focal lengths are 2 % off the stated
ones. Stated are the depth camera's intrinsics and no offset; the truth goes where only judges read.
"""

import json
from pathlib import Path

import numpy as np

from vssm_gym.data.intrinsics import CameraCalibration, ColourCalibration
from vssm_gym.envs.streams import seeded_streams
from vssm_gym.files.atomic import atomic_write
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import PARAMETERS, ColourCamera

TRUTH = "calibration_truth.json"  # beside groundtruth.txt, in the format of camera.json
BASELINE = 0.025  # m, along the rows
MISPLACED = 0.002  # m, standard deviation along columns and view
TURNED = np.radians(0.6)  # rad, standard deviation about each axis
FOCAL_ERROR = 0.02  # of both stated focal lengths
CENTRE_ERROR = 0.004  # focal lengths, standard deviation of both coordinates of the principal point


def draw_rig(camera: Camera, seed: int) -> tuple[ColourCalibration, ColourCamera]:
    """Return the stated calibration of a colour camera, and the true camera.

    Args:
        camera: the depth camera; the colour images have its size.
        seed: of side, turn, principal point, and sign of the focal lengths' error.
    """
    rng = seeded_streams(seed, ("colour rig",))["colour rig"]
    side, longer = rng.choice([-1.0, 1.0], 2)
    theta = np.zeros(PARAMETERS)
    theta[:3] = side * BASELINE, *rng.normal(0.0, MISPLACED, 2)
    theta[3:6] = rng.normal(0.0, TURNED, 3)
    theta[6:8] = np.log1p(longer * FOCAL_ERROR)
    theta[8:10] = rng.normal(0.0, CENTRE_ERROR, 2)
    stated = ColourCamera(camera, np.eye(4))
    return ColourCalibration(stated), stated.moved(theta)


def write_truth(folder: Path, calibration: CameraCalibration) -> None:
    """Write the true calibration of a recording's cameras."""
    with atomic_write(folder / TRUTH) as temporary:
        temporary.write_text(json.dumps(calibration.as_json(), indent=1))
