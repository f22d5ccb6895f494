"""Sense the contacts of the last step with a ring of switches around the robot's footprint.

    k = round(n bearing / 2 pi) mod n

The bearing is the direction from the robot to the obstacle, against the normal of the simulator's contact, in the body
frame. Of four sectors the first is ahead, followed by left, behind and right.
"""

import math
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.envs.sensors.base import GroundBody
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.errors import InputError


@dataclass(frozen=True)
class BumperConfig:
    """Configure the angular resolution of the bumper."""

    sectors: int = 4  # equal ones, the first of them centred ahead, then counter-clockwise

    def __post_init__(self) -> None:
        if isinstance(self.sectors, bool) or not (isinstance(self.sectors, int) and 1 <= self.sectors <= 64):
            raise InputError("BumperConfig", "sectors", f"1 to 64, not {self.sectors!r}")

    def mount(self, renderer: SharedRenderer) -> "BumperSensor":
        """Build the sensor; it does not use the scene."""
        return BumperSensor(self)


class BumperSensor:
    """Measure ``bumper`` int8 ``(sectors,)``, 1 where an obstacle was in contact with the robot in the last step."""

    stream = "bumper"
    parallel = True
    reads_contacts = True

    def __init__(self, config: BumperConfig) -> None:
        self.config = config
        self.spaces: dict[str, gym.Space[Any]] = {"bumper": gym.spaces.MultiBinary(config.sectors)}

    def seed(self, rng: np.random.Generator) -> None:
        """Do nothing: the switches have no noise."""

    def begin(self, body: GroundBody) -> None:
        """Do nothing: no state is kept."""

    def measure(self, body: GroundBody) -> dict[str, np.ndarray]:
        """Return the switches of the last step."""
        n = self.config.sectors
        closed = np.zeros(n, dtype=np.int8)
        closed[np.rint(n * body.contacts / (2.0 * math.pi)).astype(int) % n] = 1
        return {"bumper": closed}
