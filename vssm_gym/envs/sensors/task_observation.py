"""Add a quantity that the task gives to the robot, such as its goal, to the observation under one key."""

from collections.abc import Callable
from typing import Any
from weakref import WeakMethod

import gymnasium as gym
import numpy as np


class TaskObservation:
    """Observe one quantity of the task, without noise, as if it were the reading of a sensor.

    Args:
        key: its key in the observation.
        space: its space.
        read: returns its present value. It is a method of the environment and is referenced weakly: the environment
            holds this sensor, and a reference circle would keep the simulators of closed environments in memory until
            the garbage collector runs.
    """

    stream = "task_observation"
    parallel = True
    reads_contacts = False

    def __init__(self, key: str, space: gym.Space[Any], read: Callable[[], Any]) -> None:
        self.spaces: dict[str, gym.Space[Any]] = {key: space}
        self._key, self._read = key, WeakMethod(read)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_read": self._read()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state | {"_read": WeakMethod(state["_read"])})

    def seed(self, rng: np.random.Generator) -> None:
        """Do nothing: the value is not random."""

    def begin(self, body: object) -> None:
        """Do nothing: no state is kept."""

    def measure(self, body: object) -> dict[str, np.ndarray]:
        """Return the present value under its key."""
        read = self._read()
        assert read is not None  # the caller holds the environment
        return {self._key: read()}
