"""An inertial measurement unit: ``reading = truth + b + n``, clipped to its range, with a bias that wanders.

    n ~ N(0, density^2 / h),    b' = b + N(0, walk^2 h),    b_0 ~ N(0, bias^2)

``h`` is the time that a reading covers; densities are those of continuous time, so that an IMU of any rate is one
device. Channels: angular rate x y z (rad/s), specific force x y z (m/s^2), body frame. Numbers: Analog Devices
ADIS16448 as EuRoC states it (Burri et al., IJRR 2016).
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError


@dataclass(frozen=True)
class ImuNoise:
    """What the IMU adds."""

    gyro_density: float = 0.0  # rad/s/sqrt(Hz)
    gyro_walk: float = 0.0  # rad/s^2/sqrt(Hz)
    gyro_bias: float = 0.0  # rad/s, standard deviation at the start
    accel_density: float = 0.0  # m/s^2/sqrt(Hz)
    accel_walk: float = 0.0  # m/s^3/sqrt(Hz)
    accel_bias: float = 0.0  # m/s^2
    gyro_range: float = 35.0  # rad/s
    accel_range: float = 160.0  # m/s^2

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < np.inf:
                raise InputError("ImuNoise", field.name, f"a finite number >= 0, not {value!r}")


PRESETS = {
    "none": ImuNoise(),
    "mems": ImuNoise(1.7e-4, 2e-5, 0.02, 2e-3, 3e-3, 0.1),
}


def imu_noise(spec: str | ImuNoise) -> ImuNoise:
    """A preset by name, or the noise itself; raises :class:`InputError` for an unknown name."""
    if isinstance(spec, ImuNoise):
        return spec
    if spec not in PRESETS:
        raise InputError("imu", "name", f"one of {', '.join(PRESETS)}, or an ImuNoise; found {spec!r}")
    return PRESETS[spec]


class Imu:
    """One device with its own random stream and bias."""

    def __init__(self, noise: ImuNoise, rng: np.random.Generator) -> None:
        self.noise, self._rng = noise, rng
        self._density = np.repeat([noise.gyro_density, noise.accel_density], 3)
        self._walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3)
        self._range = np.repeat([noise.gyro_range, noise.accel_range], 3)
        self.bias = np.repeat([noise.gyro_bias, noise.accel_bias], 3) * rng.standard_normal(6)

    def __call__(self, truth: Float[np.ndarray, "n 6"], h: float) -> Float[np.ndarray, "n 6"]:
        """Readings float32 of consecutive true ``(rate, specific force)``, each over ``h`` s."""
        white, drift = self._rng.standard_normal((2, *truth.shape))
        biases = self.bias + np.cumsum(self._walk * np.sqrt(h) * drift, axis=0)
        readings = truth + biases + self._density / np.sqrt(h) * white
        self.bias = biases[-1]
        return np.clip(readings, -self._range, self._range).astype(np.float32)
