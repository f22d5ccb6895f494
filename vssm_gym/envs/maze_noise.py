"""How a maze's robot strays from its commands (the law of :func:`robots.execute`), and how its range finder errs.

Each reading errs by itself:

    r' = 0 (no reading)              with probability ``dropout``
    r' = r + e,  e ~ N(0, std^2)     otherwise; no reading where that is not positive

The Gaussian of constant width is the emission that the thesis' spatial model assumes (SPEC 11).
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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


@dataclass(frozen=True)
class RangeNoise:
    """The law of the module: ``std`` in metres, ``dropout`` a probability."""

    std: float
    dropout: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.std) and self.std >= 0.0):
            raise InputError("RangeNoise", "std", f"a finite standard deviation >= 0, not {self.std!r}")
        if not 0.0 <= self.dropout <= 1.0:
            raise InputError("RangeNoise", "dropout", f"a probability, not {self.dropout!r}")


# In a maze of the unit square: up to the robot's own diameter, and every twentieth reading missing.
RANGE_NOISE: dict[str, RangeNoise] = {
    "none": RangeNoise(0.0, 0.0),
    "low": RangeNoise(0.005, 0.0),
    "mid": RangeNoise(0.01, 0.01),
    "high": RangeNoise(0.025, 0.05),
}


def motion_noise(level: str | ExecutionNoise) -> ExecutionNoise:
    """The noise of a named level, or ``level`` itself; an unknown name raises :class:`InputError`."""
    if isinstance(level, ExecutionNoise):
        return level
    if not isinstance(level, str) or level not in MOTION_NOISE:
        expected = f"one of {', '.join(MOTION_NOISE)} or an ExecutionNoise, not {level!r}"
        raise InputError("environment", "noise", expected)
    return MOTION_NOISE[level]


def range_noise(level: str | RangeNoise) -> RangeNoise:
    """The noise of a named level, or ``level`` itself; an unknown name raises :class:`InputError`."""
    if isinstance(level, RangeNoise):
        return level
    if not isinstance(level, str) or level not in RANGE_NOISE:
        expected = f"one of {', '.join(RANGE_NOISE)} or a RangeNoise, not {level!r}"
        raise InputError("environment", "sensor_noise", expected)
    return RANGE_NOISE[level]


def measure(
    ranges: Float[np.ndarray, "*batch"], noise: RangeNoise, rng: np.random.Generator, longest: float
) -> Float[np.ndarray, "*batch"]:
    """``ranges`` (m) as measured, at most ``longest``; 0 where there is no reading.

    Draws one normal and one uniform a reading whatever the noise is, so that runs of one seed can be compared.
    """
    error, lost = noise.std * rng.standard_normal(ranges.shape), rng.random(ranges.shape) < noise.dropout
    return np.where(lost, 0.0, np.clip(ranges + error, 0.0, longest))
