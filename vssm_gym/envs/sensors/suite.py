"""Hold the sensors of one robot and their latest readings, which are the environment's observation."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np

from vssm_gym.envs.sensors.base import Sensor
from vssm_gym.errors import InputError

Body = TypeVar("Body")


class SensorSuite(Generic[Body]):
    """Hold a robot's sensors, and their latest readings.

    Args:
        source: name of the environment, for error messages.
        sensors: in any order; no two of them may have a key in common.
    """

    def __init__(self, source: str, sensors: Sequence[Sensor[Body]]) -> None:
        self._source = source
        self._sensors: list[Sensor[Body]] = []
        self._readings: dict[str, np.ndarray] | None = None  # at the robot's present pose
        self._hidden: frozenset[str] = frozenset()  # keys that are measured and not observed
        for sensor in sensors:
            self.add(sensor)

    def __iter__(self) -> Iterator[Sensor[Body]]:
        return iter(self._sensors)

    def add(self, sensor: Sensor[Body]) -> None:
        """Add a sensor; raise :class:`InputError` where one of its keys is taken."""
        if taken := sorted(set(sensor.spaces) & set(self._measured())):
            expected = f"sensors without a key in common; {', '.join(map(repr, taken))} would be measured twice"
            raise InputError(self._source, "sensors", expected)
        self._sensors.append(sensor)

    def exchange(self, old: Sequence[Sensor[Body]], new: Sequence[Sensor[Body]]) -> None:
        """Put each sensor of ``new`` in the place of the one of ``old``, which has the same keys."""
        other = {id(was): now for was, now in zip(old, new, strict=True)}
        self._sensors = [other.get(id(sensor), sensor) for sensor in self._sensors]

    def remove(self, key: str) -> None:
        """Remove the sensor of ``key``."""
        self._sensors = [sensor for sensor in self._sensors if key not in sensor.spaces]

    def hide(self, *keys: str) -> None:
        """Leave readings out of the observation; :meth:`reading` still returns them."""
        self._hidden |= frozenset(keys)

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """Return the spaces of :meth:`observation`."""
        return {key: space for key, space in self._measured().items() if key not in self._hidden}

    def _measured(self) -> dict[str, gym.Space[Any]]:
        return {key: space for sensor in self._sensors for key, space in sensor.spaces.items()}

    @property
    def streams(self) -> tuple[str, ...]:
        """Return the names of the streams that :meth:`seed` needs."""
        return tuple(dict.fromkeys(sensor.stream for sensor in self._sensors))

    @property
    def parallel(self) -> bool:
        """Return True if several robots may sense at once, in threads of one process."""
        return all(sensor.parallel for sensor in self._sensors)

    @property
    def reads_contacts(self) -> bool:
        """Return True if any sensor reads contacts."""
        return any(sensor.reads_contacts for sensor in self._sensors)

    def seed(self, streams: Mapping[str, np.random.Generator]) -> None:
        """Restart every sensor with its stream."""
        for sensor in self._sensors:
            sensor.seed(streams[sensor.stream])

    def begin(self, body: Body) -> None:
        """Start an episode with the robot as it is."""
        for sensor in self._sensors:
            sensor.begin(body)
        self.moved()

    def moved(self) -> None:
        """Discard the readings, so that the next :meth:`sense` measures again: the robot has moved."""
        self._readings = None

    def sense(self, body: Body) -> None:
        """Let every sensor measure, unless they have done so since the robot moved."""
        if self._readings is None:
            self._readings = {}
            for sensor in self._sensors:
                self._readings |= sensor.measure(body)

    def reading(self, key: str) -> np.ndarray:
        """Return the latest reading of one key; it must not be changed."""
        assert self._readings is not None
        return self._readings[key]

    def observation(self) -> dict[str, np.ndarray]:
        """Return copies of the latest readings of all sensors, without the hidden ones."""
        assert self._readings is not None
        return {key: value.copy() for key, value in self._readings.items() if key not in self._hidden}
