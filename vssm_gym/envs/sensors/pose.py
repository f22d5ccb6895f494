"""Observe the true pose of a robot on the floor, which ``observe_pose=True`` grants to oracles."""

from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.sensors.base import HasPlanar

_HIGHEST = np.array([MAX_COORDINATE, MAX_COORDINATE, np.pi])
ANYWHERE = np.array([-_HIGHEST, _HIGHEST])  # m, m, rad: the bounds of all poses


class PoseSensor:
    """Measure ``pose`` float32 ``(3,)``: the true x, y (m) and heading (rad) in the world frame, exact.

    Args:
        bounds: lowest and highest pose.
    """

    stream = "pose"
    parallel = True
    reads_contacts = False

    def __init__(self, bounds: Float[np.ndarray, "2 3"] = ANYWHERE) -> None:
        self.spaces: dict[str, gym.Space[Any]] = {"pose": gym.spaces.Box(*bounds.astype(np.float32))}

    def seed(self, rng: np.random.Generator) -> None:
        """Do nothing: the pose is exact."""

    def begin(self, body: HasPlanar) -> None:
        """Do nothing: no state is kept."""

    def measure(self, body: HasPlanar) -> dict[str, np.ndarray]:
        """Return the true pose."""
        return {"pose": body.planar.astype(np.float32)}
