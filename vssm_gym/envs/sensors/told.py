"""Hand on what the task tells the robot, such as its goal, as one more key of the observation."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np


class Told:
    """What is told under one key; neither measured nor noisy.

    Args:
        key: of the observation.
        space: of what is told.
        tell: returns it; a method of the environment, so that it can be pickled.
    """

    stream = "told"
    parallel = True

    def __init__(self, key: str, space: gym.Space[Any], tell: Callable[[], np.ndarray]) -> None:
        self.spaces: dict[str, gym.Space[Any]] = {key: space}
        self._key, self._tell = key, tell

    def seed(self, rng: np.random.Generator) -> None:
        """Nothing is random."""

    def begin(self, body: object) -> None:
        """Nothing is kept."""

    def measure(self, body: object) -> dict[str, np.ndarray]:
        """Return what is told now."""
        return {self._key: self._tell()}
