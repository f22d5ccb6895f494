"""Measure the inertial readings of a flying body and, for oracles, its true pose and velocity."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.sensors.imu import ImuSensorNoise, NoisyImu
from vssm_gym.geometry.axes import Matrix4


@dataclass(frozen=True)
class FlyingBody:
    """Hold the true state of a flying body at one moment. It is ground truth: sensors read it, agents never do."""

    T_world_body: Matrix4
    velocity: Float[np.ndarray, "3"]  # m/s, world
    T_body_cam: Matrix4
    dt: float  # s since the measurement before
    readings: Float[np.ndarray, "n 6"]  # exact specific force (m/s^2) and rate (rad/s) since then, body frame
    imu_period: float  # s between the rows of `readings`

    @cached_property
    def T_world_cam(self) -> Matrix4:
        """Return the pose of the camera."""
        return self.T_world_body @ self.T_body_cam


class ImuSensor:
    """Measure ``imu`` float32 ``(n, 6)``: the readings since the last image, oldest first; m/s^2, rad/s, body frame.

    It is restarted for each flight, with a newly drawn bias.

    Args:
        noise: errors added to the exact readings.
        substeps: number of readings in a step.
    """

    stream = "imu"
    parallel = True
    reads_contacts = False

    def __init__(self, noise: ImuSensorNoise, substeps: int) -> None:
        self.noise = noise
        readings = gym.spaces.Box(-MAX_COORDINATE, MAX_COORDINATE, (substeps, 6), np.float32)
        self.spaces: dict[str, gym.Space[Any]] = {"imu": readings}
        self._rng: np.random.Generator | None = None
        self._imu: NoisyImu | None = None

    def seed(self, rng: np.random.Generator) -> None:
        """Draw biases and errors from this stream."""
        self._rng = rng

    def begin(self, body: FlyingBody) -> None:
        """Restart the IMU with a new bias."""
        assert self._rng is not None
        self._imu = NoisyImu(self.noise, self._rng)

    def measure(self, body: FlyingBody) -> dict[str, np.ndarray]:
        """Return the readings since the last measurement."""
        assert self._imu is not None
        return {"imu": self._imu(body.readings, body.imu_period).astype(np.float32)}


class FlightPoseSensor:
    """Measure the true ``pose`` and ``velocity`` of a flying body.

    ``pose`` is float32 ``(7,)``: position (m) and quaternion x y z w; ``velocity`` is float32 ``(3,)``, m/s. World
    frame.
    """

    stream = "pose"
    parallel = True
    reads_contacts = False

    def __init__(self) -> None:
        self.spaces: dict[str, gym.Space[Any]] = {
            "pose": gym.spaces.Box(-MAX_COORDINATE, MAX_COORDINATE, (7,), np.float32),
            "velocity": gym.spaces.Box(-MAX_COORDINATE, MAX_COORDINATE, (3,), np.float32),
        }

    def seed(self, rng: np.random.Generator) -> None:
        """Do nothing: the pose is exact."""

    def begin(self, body: FlyingBody) -> None:
        """Do nothing: no state is kept."""

    def measure(self, body: FlyingBody) -> dict[str, np.ndarray]:
        """Return the true pose and velocity."""
        quaternion = Rotation.from_matrix(body.T_world_body[:3, :3]).as_quat(canonical=True)
        pose = np.concatenate([body.T_world_body[:3, 3], quaternion])
        return {"pose": pose.astype(np.float32), "velocity": body.velocity.astype(np.float32)}
