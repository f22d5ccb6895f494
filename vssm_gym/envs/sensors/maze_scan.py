"""Scan a maze: the exact ranges of :func:`vssm_gym.envs.physics.planar.scan` with the errors of a scanner."""

from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.physics.planar import scan
from vssm_gym.envs.sensors.base import HasPlanar
from vssm_gym.envs.sensors.lidar import LidarConfig, measured


class MazeScan:
    """Measure ``scan`` float32 ``(beams,)``: ranges in m, beam 0 ahead, counter-clockwise; 0 = no reading.

    Args:
        config: beams, largest range and noise; the fan is a full circle.
        rectangles: the maze's walls.
    """

    stream = "sensors"
    parallel = True
    reads_contacts = False

    def __init__(self, config: LidarConfig, rectangles: Float[np.ndarray, "m 6"]) -> None:
        self.config, self._rectangles = config, rectangles
        space = gym.spaces.Box(0.0, config.max_range, (config.beams,), np.float32)
        self.spaces: dict[str, gym.Space[Any]] = {"scan": space}
        self._rng: np.random.Generator | None = None

    def seed(self, rng: np.random.Generator) -> None:
        """Draw errors from this stream."""
        self._rng = rng

    def begin(self, body: HasPlanar) -> None:
        """Do nothing: the errors' stream continues."""

    def measure(self, body: HasPlanar) -> dict[str, np.ndarray]:
        """Scan once from the robot's centre."""
        assert self._rng is not None
        ranges = scan(body.planar[None], self._rectangles, self.config.beams)[0]
        return {"scan": measured(ranges, self.config, self._rng)}
