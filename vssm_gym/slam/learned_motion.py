"""Give SLAM the learned transition of a flying body: its file, the level of the world, and the readings between images.

Gravity and the gyroscope's bias are measured while the body rests, as for :mod:`vssm_gym.inference.prism.imu_control`.
The learned transition has the gyroscope's bias of the flights that it was learned from; that of this one replaces it.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.inference.prism.imu_control import ImuControl
from vssm_gym.model.transition.calibrated import CalibratedImu
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.learned_file import load_transition
from vssm_gym.model.transition.mounted import Mounted

READINGS = 6  # numbers in a reading of an IMU: specific force and rate


def load_flight_transition(path: str | Path) -> LearnedTransition:
    """Read a learned transition of a body with an IMU.

    Raises:
        InputError: not such a file, or a transition of a robot's commands, or one that reads more than an IMU.
    """
    stored = load_transition(path)
    if stored.kind != "imu":
        expected = f"imu: a transition that was learned from flights; found {stored.kind}, of a robot's commands"
        raise InputError(path, "kind", expected)
    if stored.transition.controls != READINGS:
        found = stored.transition.controls
        raise InputError(path, "controls", f"{READINGS} numbers, the readings of an IMU; the transition reads {found}")
    return stored.transition


def check_flight(sequence: Sequence) -> None:
    """Refuse a recording without readings of an IMU, or without the camera's pose on the body.

    Raises:
        InputError: either is missing.
    """
    if sequence.T_body_cam is None or not len(sequence.imu):
        expected = "imu.txt, and T_body_cam in camera.json, for the learned transition of a flight"
        raise InputError(sequence.root, "imu", expected)


class LearnedMotion:
    """Hold the transition of the camera of one recording, and compute its controls.

    Args:
        learned: of the body.
        sequence: with readings of an IMU, and the camera's pose on the body.
        start: s, stamp of the first image, whose frame is the world; the body rests then.

    Attributes:
        transition: of the camera, in the first camera's frame.
    """

    def __init__(self, learned: LearnedTransition, sequence: Sequence, start: float) -> None:
        assert sequence.T_body_cam is not None
        assert isinstance(learned.nominal, CalibratedImu)
        at_rest = ImuControl(sequence.imu, sequence.T_body_cam, start)
        level = jnp.asarray(level_of(at_rest.gravity), jnp.float32)
        self.transition = Mounted(learned, level, jnp.asarray(sequence.T_body_cam, jnp.float32))
        rates = sequence.imu[:, 1:4] - at_rest.gyro_bias + np.asarray(learned.nominal.constants.gyro_bias)
        self._times, self._readings = sequence.imu[:, 0], np.concatenate([sequence.imu[:, 4:7], rates], axis=1)

    def __call__(self, before: float, now: float) -> Float[np.ndarray, "6"]:
        """Return the mean reading between two stamps: specific force (m/s^2) and rate (rad/s), body frame.

        Where there is none, the last reading before them is taken to last.
        """
        first, last = np.searchsorted(self._times, [before, now], side="right")
        if first == last:
            return self._readings[max(first - 1, 0)]
        # A reading is the mean over the time since the previous one; the first of them may have begun before.
        lasted = np.diff(np.clip(self._times[first:last], before, now), prepend=before)
        return np.average(self._readings[first:last], axis=0, weights=np.maximum(lasted, 1e-9))


def level_of(gravity: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return ``T_level_world``, the smallest rotation that makes gravity (m/s^2, in the world) point down.

    Where gravity points up in the world, every half turn about a level axis is smallest: that about x is taken.
    """
    down = gravity / np.linalg.norm(gravity)
    axis, cosine = np.cross(down, [0.0, 0.0, -1.0]), -down[2]
    sine = np.linalg.norm(axis)
    turn = np.arctan2(sine, cosine) * (axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0]))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    return T
