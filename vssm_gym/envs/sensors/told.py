"""Hand on what the task tells the robot, such as its goal, as one more key of the observation."""

from collections.abc import Callable
from typing import Any
from weakref import WeakMethod

import gymnasium as gym
import numpy as np


class Told:
    """What is told under one key; neither measured nor noisy.

    Args:
        key: of the observation.
        space: of what is told.
        tell: returns it; a method of the environment, referred to weakly: the environment holds this sensor, and
            a circle would keep simulators of closed environments in memory until the garbage collector comes.
    """

    stream = "told"
    parallel = True
    feels = False

    def __init__(self, key: str, space: gym.Space[Any], tell: Callable[[], Any]) -> None:
        self.spaces: dict[str, gym.Space[Any]] = {key: space}
        self._key, self._tell = key, WeakMethod(tell)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_tell": self._tell()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state | {"_tell": WeakMethod(state["_tell"])})

    def seed(self, rng: np.random.Generator) -> None:
        """Nothing is random."""

    def begin(self, body: object) -> None:
        """Nothing is kept."""

    def measure(self, body: object) -> dict[str, np.ndarray]:
        """Return what is told now."""
        tell = self._tell()
        assert tell is not None  # whoever looks holds the environment
        return {self._key: tell()}
