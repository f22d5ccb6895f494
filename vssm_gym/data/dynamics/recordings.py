"""Read the motion of our own recordings: TUM folders with ``groundtruth.txt`` and commands, or readings of an IMU.

The poses are those of the camera; ``camera.json`` says where it is on the body.
"""

from pathlib import Path

import numpy as np

from vssm_gym.data.dynamics.log import DynamicsLog, Kind
from vssm_gym.data.sequences import load_sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse

COMMANDS: dict[int, Kind] = {3: "holonomic", 2: "car"}  # numbers in a command


def read_recording(folder: str | Path) -> DynamicsLog:
    """Read poses and controls of a recorded flight, robot or car; images are not read.

    Raises:
        InputError: no true poses, no place of the camera on the body, neither commands nor readings of an IMU, or a
            command of another length.
    """
    sequence = load_sequence(folder)
    if sequence.truth is None:
        raise InputError(folder, "groundtruth.txt", "the poses of the motion")
    if sequence.T_body_cam is None:
        raise InputError(folder, "camera.json", "T_body_cam, the camera's pose on the body")
    times, T_world_cam = sequence.truth
    T_world_body = T_world_cam @ inverse(np.asarray(sequence.T_body_cam, float))
    if len(sequence.imu):
        controls = sequence.imu[:, [4, 5, 6, 1, 2, 3]]
        return DynamicsLog(str(folder), "imu", times, T_world_body, sequence.imu[:, 0], controls)
    if not (Path(folder) / "controls.txt").is_file():
        raise InputError(folder, "controls.txt", "the commands of a drive, or imu.txt: this recording has neither")
    width = sequence.controls.shape[1] - 1
    if width not in COMMANDS:
        expected = f"a time and {' or '.join(map(str, COMMANDS))} numbers a line, or imu.txt; found {width}"
        raise InputError(folder, "controls.txt", expected)
    return DynamicsLog(
        str(folder), COMMANDS[width], times, T_world_body, sequence.controls[:, 0], sequence.controls[:, 1:]
    )
