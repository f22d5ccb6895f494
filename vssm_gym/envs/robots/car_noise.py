"""Simulate the actuators of a car: lagging servos, a linkage with backlash, a drooping battery, and slippery floors.

    speed'    = ((1 + c) d(t) (1 + e_v) v - speed) / lag_v          d(t) = 1 - droop (1 - exp(-t / BATTERY))
    servo'    = clip((steering + trim + e_s - servo) / lag_s, -rate, rate)
    wheels    = servo within +-backlash / 2 of where they were, else dragged along (a play operator)
    friction  = mu exp(patchiness n)

``c ~ N(0, calibration^2)`` and ``trim ~ N(0, trim^2)`` are the car's own, drawn when an episode begins; ``e_v ~ N(0,
speed_jitter^2)``, ``e_s ~ N(0, steering_jitter^2)`` and ``n ~ N(0, 1)`` are drawn every control step. The outputs are
set points of the rear wheels and of the steering. The motion that follows is rigid-body physics
(:mod:`vssm_gym.envs.robots.car_body`): the wheels spin and skid wherever the tyres' friction does not suffice.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from vssm_gym.envs.presets import Presets
from vssm_gym.errors import InputError

BATTERY = 300.0  # s, time constant of the battery's droop
TICK = 0.01  # s between set points


@dataclass(frozen=True)
class CarNoise:
    """Define the imperfections of one car; see the module for the laws. All numbers >= 0."""

    speed_lag: float = 0.0  # s, time constant
    steering_lag: float = 0.0  # s
    steering_rate: float = math.inf  # rad/s, the servo's fastest
    backlash: float = 0.0  # rad, full play of the steering
    calibration: float = 0.0  # fraction of the speed, standard deviation from car to car
    trim: float = 0.0  # rad, standard deviation of the steering's zero from car to car
    droop: float = 0.0  # fraction of the speed that an empty battery costs
    friction: float = 1.0  # of tyres on the floor
    patchiness: float = 0.0  # standard deviation of the friction's logarithm
    speed_jitter: float = 0.0  # fraction of the speed, standard deviation of a step
    steering_jitter: float = 0.0  # rad, standard deviation of a step

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            endless = field.name == "steering_rate" and value == math.inf
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not (number and value >= 0.0 and (math.isfinite(value) or endless)):
                raise InputError("CarNoise", field.name, f"a finite number >= 0; found {value!r:.80}")
        for name in ("friction", "steering_rate"):
            if getattr(self, name) == 0.0:
                raise InputError("CarNoise", name, "a number above 0: the car could not move")
        if self.droop >= 1.0:
            raise InputError("CarNoise", "droop", f"a share below 1; found {self.droop!r}")


NOISE_LEVELS: dict[str, CarNoise] = {
    "none": CarNoise(),
    "low": CarNoise(
        speed_lag=0.05,
        steering_lag=0.03,
        steering_rate=8.0,
        backlash=math.radians(0.5),
        calibration=0.01,
        trim=math.radians(0.3),
        droop=0.02,
        friction=0.9,
        patchiness=0.05,
        speed_jitter=0.01,
        steering_jitter=math.radians(0.3),
    ),
    "mid": CarNoise(
        speed_lag=0.1,
        steering_lag=0.06,
        steering_rate=5.0,
        backlash=math.radians(1.5),
        calibration=0.03,
        trim=math.radians(0.8),
        droop=0.05,
        friction=0.7,
        patchiness=0.1,
        speed_jitter=0.03,
        steering_jitter=math.radians(0.8),
    ),
    "high": CarNoise(
        speed_lag=0.2,
        steering_lag=0.12,
        steering_rate=3.0,
        backlash=math.radians(3.0),
        calibration=0.06,
        trim=math.radians(1.5),
        droop=0.1,
        friction=0.45,
        patchiness=0.2,
        speed_jitter=0.06,
        steering_jitter=math.radians(1.5),
    ),
}


car_noise = Presets("environment", "noise", CarNoise, NOISE_LEVELS)


class CarActuators:
    """Turn commands into set points of the wheels, through the servos and the battery of one car.

    Args:
        noise: their imperfections.
        rng: the dynamics stream. The start of an episode draws two normals and every step three, for every command,
            so that runs which share a seed share the noise of step ``t``.
    """

    def __init__(self, noise: CarNoise, rng: np.random.Generator) -> None:
        self.noise, self._rng = noise, rng
        own_speed, own_trim = rng.standard_normal(2)
        self._gain, self._trim = 1.0 + noise.calibration * own_speed, noise.trim * own_trim
        self.time = 0.0  # s that the battery has served
        self.speed = 0.0  # m/s, set point now
        self._servo = self._trim  # rad, where the servo stands
        self.steering = self._trim  # rad, where its linkage holds the wheels

    def __call__(
        self, ramp: Float[np.ndarray, "2"], steering: float, dt: float
    ) -> tuple[Float[np.ndarray, "ticks 2"], float]:
        """Return the set points of the wheels over one control step.

        Args:
            ramp: commanded speed at its begin and its end, m/s; it changes linearly between them.
            steering: commanded angle, rad.
            dt: length of the step, s, a whole number of TICKs.

        Returns:
            ``(speed m/s, steering rad)`` every TICK, and the tyres' friction in this step.
        """
        noise = self.noise
        by_speed, by_steering, by_floor = self._rng.standard_normal(3)
        factor = self._gain * (1.0 + noise.speed_jitter * by_speed)
        aim = steering + self._trim + noise.steering_jitter * by_steering
        follow_speed, follow_steering = _share(noise.speed_lag), _share(noise.steering_lag)
        fastest, play = noise.steering_rate * TICK, 0.5 * noise.backlash
        ticks = round(dt / TICK)
        points = np.empty((ticks, 2))
        for i in range(ticks):
            self.time += TICK
            droop = 1.0 - noise.droop * -math.expm1(-self.time / BATTERY)
            wanted = factor * droop * (ramp[0] + (ramp[1] - ramp[0]) * (i + 1) / ticks)
            self.speed += follow_speed * (wanted - self.speed)
            self._servo += min(max(follow_steering * (aim - self._servo), -fastest), fastest)
            self.steering = min(max(self.steering, self._servo - play), self._servo + play)
            points[i] = self.speed, self.steering
        return points, noise.friction * math.exp(noise.patchiness * by_floor)


def _share(lag: float) -> float:
    """Return the fraction of the distance to its input that a first-order lag covers in a TICK."""
    return 1.0 if lag == 0.0 else -math.expm1(-TICK / lag)
