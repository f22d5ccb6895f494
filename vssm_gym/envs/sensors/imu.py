"""Measure specific force and angular rate of a moving body in the body frame, with bias and noise: a strapdown IMU.

    a = R^T (dv/dt - g) + b_a + n_a,   w = w_body + b_g + n_g,      g = (0, 0, -9.81), world
    n ~ N(0, density^2 / dt),   b' = b + walk sqrt(dt) N(0, 1)      a step of dt later

Densities are those of continuous time, as calibration sheets state them (EuRoC's ``sensor.yaml``). Readings are rows
``(a, w)``, m/s^2 and rad/s: the controls of :mod:`vssm_gym.model.transition.imu`, which integrates them to the
trajectory.

Scale errors, axis misalignment, saturation, vibration and temperature are not modelled.

Sources: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016 (ADIS16448); Geneva et
al., "OpenVINS", ICRA 2020, and its AR-table recordings (D455); Woodman, "An introduction to inertial navigation", 2007.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.envs.presets import Presets
from vssm_gym.errors import InputError
from vssm_gym.geometry.gravity import GRAVITY


@dataclass(frozen=True)
class ImuSensorNoise:
    """Define the errors of the sensor; zero switches an effect off."""

    accel_density: float = 0.0  # m/s^2 / sqrt(Hz)
    accel_walk: float = 0.0  # m/s^3 / sqrt(Hz)
    accel_bias: float = 0.0  # m/s^2, standard deviation of each axis' bias when it is switched on
    gyro_density: float = 0.0  # rad/s / sqrt(Hz)
    gyro_walk: float = 0.0  # rad/s^2 / sqrt(Hz)
    gyro_bias: float = 0.0  # rad/s

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < math.inf:
                raise InputError("ImuSensorNoise", field.name, f"a finite number >= 0, not {value!r}")


PRESETS = {
    "none": ImuSensorNoise(),
    # Analog Devices ADIS16448, EuRoC's drone: its calibration sheet. Switch-on biases: the part's data sheet.
    "adis16448": ImuSensorNoise(
        accel_density=2.0e-3,
        accel_walk=3.0e-3,
        accel_bias=0.2,
        gyro_density=1.6968e-4,
        gyro_walk=1.9393e-5,
        gyro_bias=0.0087,
    ),
    # Intel RealSense D455 (Bosch BMI055): Allan deviations published with OpenVINS. Switch-on biases: the part's data
    # sheet, before any calibration.
    "realsense": ImuSensorNoise(
        accel_density=1.038e-3,
        accel_walk=4.13e-5,
        accel_bias=0.69,
        gyro_density=1.027e-4,
        gyro_walk=1.11e-6,
        gyro_bias=0.0175,
    ),
}


imu_noise = Presets("environment", "imu_noise", ImuSensorNoise, PRESETS)


def specific_force(
    R_world_body: Float[np.ndarray, "*batch 3 3"], acceleration: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """``R^T (a - g)``, m/s^2, body frame: what an accelerometer measures; +9.81 upwards at rest.

    Args:
        R_world_body: orientation of the body.
        acceleration: of the body, m/s^2, world frame.
    """
    return np.einsum("...ji,...j->...i", R_world_body, np.asarray(acceleration) - GRAVITY)


def readings(
    T_world_body: Float[np.ndarray, "n_1 4 4"], velocity: Float[np.ndarray, "n_1 3"], dt: float
) -> Float[np.ndarray, "n 6"]:
    """Return the exact mean readings ``(a, w)`` of each step between states ``dt`` s apart.

        a = R^T ((v' - v) / dt - g),    w = log(R^T R') / dt

    Integrating ``v' = v + (R a + g) dt``, ``R' = R exp(w dt)`` gives these states again.

    Args:
        T_world_body: poses, m.
        velocity: world frame, m/s.
        dt: length of a step, s.

    Returns:
        ``(n, 6)`` readings of the ``n`` steps between ``n + 1`` states: m/s^2, rad/s, body frame.
    """
    R = T_world_body[:, :3, :3]
    a = specific_force(R[:-1], np.diff(velocity, axis=0) / dt)
    turn = np.einsum("nji,njk->nik", R[:-1], R[1:])
    return np.concatenate([a, Rotation.from_matrix(turn).as_rotvec() / dt], axis=-1)


class NoisyImu:
    """Add bias and noise to exact readings; one object is one IMU with its own random stream and biases.

    Args:
        noise: its errors, or a preset's name.
        rng: its stream; the same stream gives the same bytes for any division of the readings into calls.
    """

    def __init__(self, noise: str | ImuSensorNoise, rng: np.random.Generator) -> None:
        noise = imu_noise(noise)
        self.noise = noise
        self._rng = rng
        self._density = np.repeat([noise.accel_density, noise.gyro_density], 3)
        self._walk = np.repeat([noise.accel_walk, noise.gyro_walk], 3)
        self._bias = np.repeat([noise.accel_bias, noise.gyro_bias], 3) * rng.standard_normal(6)

    @property
    def bias(self) -> Float[np.ndarray, "6"]:
        """Return the present bias of ``(a, w)``: ground truth, not for agents."""
        return self._bias.copy()

    def __call__(self, exact: Float[np.ndarray, "*n 6"], dt: float) -> Float[np.ndarray, "*n 6"]:
        """Return the measured readings of exact ones ``(a, w)``, ``dt`` s apart, one or several in order of time."""
        exact = np.asarray(exact, dtype=np.float64)
        white, steps = np.moveaxis(self._rng.standard_normal((*exact.shape[:-1], 2, 6)), -2, 0)
        walked = np.cumsum(
            np.concatenate([self._bias[None], (math.sqrt(dt) * self._walk * steps).reshape(-1, 6)]), axis=0
        )
        self._bias = walked[-1]
        return exact + walked[:-1].reshape(exact.shape) + self._density / math.sqrt(dt) * white
