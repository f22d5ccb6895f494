"""Scan with a planar laser: ranges to the first box along a fan of beams, with the errors of a real scanner.

The law of the errors is that of every scanner here, that of the mazes included (:mod:`vssm_gym.envs.maze_noise` has its
levels).

    a_k = fov ((k + 1/2) / beams - 1/2)        direction of beam k, counter-clockwise from the robot's x axis, rad
    r'  = r + e,  e ~ N(0, sigma(r)^2),        sigma(r) = floor + growth r

Each beam stands for ``fov / beams`` and points along its middle, so that a full circle has no beam twice. Ranges are
metres along the beam, float32; **0 = no reading**, as in depth images: nothing within ``max_range``, an obstacle nearer
than ``min_range``, or a lost return.

Sources: data sheets of Hokuyo's URG-04LX (indoor scanner of small robots) and Slamtec's RPLIDAR A1.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.physics.tracing import Tracer
from vssm_gym.envs.presets import Presets
from vssm_gym.envs.sensors.base import HasPose
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4


@dataclass(frozen=True)
class LidarNoise:
    """Define the errors of ranges; zero switches an effect off."""

    floor: float = 0.0  # m, standard deviation near by
    growth: float = 0.0  # of the standard deviation with the range
    dropout: float = 0.0  # fraction of returns that are lost

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < math.inf:
                raise InputError("LidarNoise", field.name, f"a finite number >= 0, not {value!r}")
        if self.dropout > 1.0:
            raise InputError("LidarNoise", "dropout", f"a share, 1 at most, not {self.dropout!r}")

    def range_std(self, ranges: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Return the standard deviation ``sigma(r)``, m, of ranges in m."""
        return self.floor + self.growth * ranges


PRESETS = {
    "none": LidarNoise(),
    # The sheets' limits (URG-04LX: 10 mm up to 1 m, then 1 %; A1: 1 to 2 %) are taken for three standard deviations;
    # shares of lost returns are ours.
    "hokuyo": LidarNoise(floor=0.001, growth=0.003, dropout=0.005),
    "rplidar": LidarNoise(floor=0.001, growth=0.005, dropout=0.02),
}


lidar_noise = Presets("lidar", "noise", LidarNoise, PRESETS)


@dataclass(frozen=True)
class LidarConfig:
    """Configure the fan of beams, horizontal in the robot's frame, and the errors of its ranges.

    ``noise`` is a :class:`LidarNoise`, the name of a preset, or a mapping of its fields.
    """

    beams: int = 64
    fov: float = 2.0 * math.pi  # rad
    min_range: float = 0.0  # m
    max_range: float = 10.0  # m
    height: float = 0.3  # m above the robot's origin
    noise: LidarNoise = LidarNoise()

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", lidar_noise(self.noise))
        for field in ("fov", "min_range", "max_range", "height"):
            if not isinstance(value := getattr(self, field), int | float):
                raise InputError("LidarConfig", field, f"a number, not {value!r:.80}")
        if isinstance(self.beams, bool) or not (isinstance(self.beams, int) and 1 <= self.beams <= 65536):
            raise InputError("LidarConfig", "beams", f"1 to 65536, not {self.beams!r}")
        if not 0.0 < self.fov <= 2.0 * math.pi:
            raise InputError("LidarConfig", "fov", f"an angle in radians above 0, 2 pi at most, not {self.fov!r}")
        if not (0.0 <= self.min_range < self.max_range < math.inf):
            found = f"{self.min_range!r}, {self.max_range!r}"
            raise InputError("LidarConfig", "max_range", f"0 <= min_range < max_range, finite, m; found {found}")
        if not math.isfinite(self.height):
            raise InputError("LidarConfig", "height", f"a finite number of metres, not {self.height!r}")

    def angles(self) -> Float[np.ndarray, "beams"]:
        """Return the direction of each beam, rad, ascending."""
        return self.fov * ((np.arange(self.beams) + 0.5) / self.beams - 0.5)

    def mount(self, renderer: SharedRenderer) -> "LidarSensor":
        """Build the scanner in a scene."""
        return LidarSensor(self, renderer)


class LidarSensor:
    """Measure ``scan`` float32 ``(beams,)``: ranges in m, counter-clockwise, 0 = no reading; see the module.

    Args:
        config: the fan and its noise.
        renderer: the scene; the robot itself is transparent.
    """

    stream = "lidar"
    reads_contacts = False

    def __init__(self, config: LidarConfig, renderer: SharedRenderer) -> None:
        self.config, self._lidar = config, Lidar(config, renderer.tracer)
        space = gym.spaces.Box(0.0, config.max_range, (config.beams,), np.float32)
        self.spaces: dict[str, gym.Space[Any]] = {"scan": space}
        self.parallel = renderer.tracer.parallel
        self._rng: np.random.Generator | None = None

    def seed(self, rng: np.random.Generator) -> None:
        """Draw errors from this stream."""
        self._rng = rng

    def begin(self, body: HasPose) -> None:
        """Do nothing: the errors' stream continues."""

    def measure(self, body: HasPose) -> dict[str, np.ndarray]:
        """Scan once."""
        assert self._rng is not None
        return {"scan": measured(self._lidar.scan(body.T_world_body), self.config, self._rng)}


class Lidar:
    """Scan exactly, with one call of the tracer.

    Args:
        config: the fan.
        tracer: the scene's ray tracer (:func:`vssm_gym.envs.sensors.make_tracer`).
    """

    def __init__(self, config: LidarConfig, tracer: Tracer) -> None:
        self.config = config
        self._tracer = tracer
        angles = config.angles()
        self._beams = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)

    def scan(self, T_world_body: Matrix4) -> Float[np.ndarray, "beams"]:
        """Return the exact ranges, float32, m; 0 where there is no obstacle in range, or one that is too near.

        Args:
            T_world_body: ``(4, 4)`` pose of the robot, m.
        """
        T = np.asarray(T_world_body, dtype=np.float64)
        origin = T[:3, :3] @ [0.0, 0.0, self.config.height] + T[:3, 3]
        directions = np.ascontiguousarray(self._beams @ T[:3, :3].T, dtype=np.float32)
        ranges, _ = self._tracer.trace(origin, directions)  # of unit length, so that multiples are metres
        return _within(ranges, self.config)


def measured(
    ranges: Float[np.ndarray, "*batch"], config: LidarConfig, rng: np.random.Generator
) -> Float[np.ndarray, "*batch"]:
    """Return measured ranges ``r' = r + e`` of exact ones, with lost returns and nothing out of range; float32, m.

    Each call draws the same amount from ``rng`` for all ranges; the same stream gives the same bytes.
    """
    noise = config.noise
    error, chance = rng.standard_normal(ranges.shape), rng.random(ranges.shape)
    read = ranges + noise.range_std(ranges) * error
    return _within(np.where((ranges > 0.0) & (chance >= noise.dropout), read, 0.0).astype(np.float32), config)


def _within(ranges: np.ndarray, config: LidarConfig) -> np.ndarray:
    return np.where((ranges < config.min_range) | (ranges > config.max_range), np.float32(0.0), np.maximum(ranges, 0.0))
