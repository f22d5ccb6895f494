"""How a maze's robot strays from its commands and how its scanner errs: levels of two laws that stand elsewhere.

Motion errs as :func:`vssm_gym.envs.robots.execute` says, ranges as :mod:`vssm_gym.envs.lidar` does, here with a width
that does not grow with the range: that Gaussian is the emission which the thesis' spatial model assumes (SPEC 11).
"""

import math

from vssm_gym.envs.lidar import LidarNoise
from vssm_gym.envs.robots import ExecutionNoise
from vssm_gym.errors import InputError

# low: dead reckoning errs by 0.14 after 3000 steps, as the thesis' path integration does (0.14 +- 0.1); high: SPEC 6's
# low, 3 degrees and 10 % of a body length a step, with which it is lost after 500.
MOTION_NOISE: dict[str, ExecutionNoise] = {
    "none": ExecutionNoise(0.0, 0.0),
    "low": ExecutionNoise(math.radians(0.35), 0.0005),
    "mid": ExecutionNoise(math.radians(1.0), 0.001),
    "high": ExecutionNoise(math.radians(3.0), 0.0025),
}


# In a maze of the unit square: up to the robot's own diameter, and every twentieth reading missing.
RANGE_NOISE: dict[str, LidarNoise] = {
    "none": LidarNoise(),
    "low": LidarNoise(floor=0.005),
    "mid": LidarNoise(floor=0.01, dropout=0.01),
    "high": LidarNoise(floor=0.025, dropout=0.05),
}


def motion_noise(level: str | ExecutionNoise) -> ExecutionNoise:
    """The noise of a named level, or ``level`` itself; an unknown name raises :class:`InputError`."""
    if isinstance(level, ExecutionNoise):
        return level
    if not isinstance(level, str) or level not in MOTION_NOISE:
        expected = f"one of {', '.join(MOTION_NOISE)} or an ExecutionNoise, not {level!r}"
        raise InputError("environment", "noise", expected)
    return MOTION_NOISE[level]


def range_noise(level: str | LidarNoise) -> LidarNoise:
    """The noise of a named level, or ``level`` itself; an unknown name raises :class:`InputError`."""
    if isinstance(level, LidarNoise):
        return level
    if not isinstance(level, str) or level not in RANGE_NOISE:
        expected = f"one of {', '.join(RANGE_NOISE)} or a LidarNoise, not {level!r}"
        raise InputError("environment", "sensor_noise", expected)
    return RANGE_NOISE[level]
