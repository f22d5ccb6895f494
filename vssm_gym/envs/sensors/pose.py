"""Observe the true pose of a robot on the floor: the privilege of oracles, which ``observe_pose=True`` grants."""

from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.sensors.base import EXTENT, HasPlanar

ANYWHERE = np.array([[-EXTENT, -EXTENT, -np.pi], [EXTENT, EXTENT, np.pi]])  # m, m, rad


class PoseSensor:
    """``pose`` float32 ``(3,)``: the true x, y (m) and heading (rad) in the world frame, exact.

    Args:
        bounds: lowest and highest pose that there is.
    """

    stream = "pose"
    parallel = True
    reads_contacts = False

    def __init__(self, bounds: Float[np.ndarray, "2 3"] = ANYWHERE) -> None:
        self.spaces: dict[str, gym.Space[Any]] = {"pose": gym.spaces.Box(*bounds.astype(np.float32))}

    def seed(self, rng: np.random.Generator) -> None:
        """Nothing is random."""

    def begin(self, body: HasPlanar) -> None:
        """Nothing is kept."""

    def measure(self, body: HasPlanar) -> dict[str, np.ndarray]:
        """Return the pose as it is."""
        return {"pose": body.planar.astype(np.float32)}
