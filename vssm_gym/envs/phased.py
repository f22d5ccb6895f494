"""Define environments whose reset and step run in phases: move, sense, report.

    reset = begin, sense, report        step = advance, sense, report

Moving takes microseconds and is done one environment after another; sensing renders an image and is done in parallel by
a vector environment (:mod:`vssm_gym.envs.vector`). An environment of this suite implements the phases only.

After the step that terminates or truncates an episode comes a reset: a further step raises ``ResetNeeded``. A wrapper's
truncation (``TimeLimit``) is outside: only the wrapper knows of it.
"""

import abc
import inspect
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np

from vssm_gym.envs.rendering.captions import Caption, Panel, Tally
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.errors import InputError

Report = tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]

_SCANNER = 'sensors=["lidar"], or sensors=[{"sensor": "lidar", "beams": 64, "noise": "hokuyo"}]'
_REPLACED = {"lidar": _SCANNER, "lidar_noise": _SCANNER}  # keywords of earlier versions, and their replacements


class PhasedEnv(gym.Env[dict[str, Any], np.ndarray], abc.ABC):
    """Compose Gymnasium's ``reset`` and ``step`` of ``begin``, ``advance``, ``sense`` and ``report``."""

    passes_to: ClassVar[type | None] = None  # the class whose keywords the constructor accepts besides its own
    refuses: ClassVar[Mapping[str, str]] = {}  # keywords of that class which it does not accept, and why
    __signature__: ClassVar[inspect.Signature]
    parallel: bool = False  # True if several environments may sense at once, in threads of one process
    frames: Frames  # set by the constructor
    tally: Tally | None = None  # of the episode under way; None before the first one
    _closed: bool = False
    _running: bool = False  # True from a reset to the step that ends the episode

    def __init_subclass__(cls, **given: Any) -> None:
        """State the keywords of the constructor, which ``help`` and the reference would take from ``__new__``."""
        super().__init_subclass__(**given)
        cls.__signature__ = signature_of(cls)

    def __new__(cls, *_: Any, **given: Any) -> Self:
        """Raise :class:`InputError`, which lists the keywords of the constructor, for any other keyword."""
        taken = keywords_of(cls)
        for name in given:
            if name in _REPLACED and "sensors" in taken:
                raise InputError(cls.__name__.removesuffix("Env"), name, _REPLACED[name])
            if name in cls.refuses:
                raise InputError(cls.__name__.removesuffix("Env"), name, cls.refuses[name])
            if name not in taken:
                raise InputError(cls.__name__.removesuffix("Env"), name, f"one of its keywords: {', '.join(taken)}")
        return super().__new__(cls)

    @abc.abstractmethod
    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start an episode; a seed restarts all streams of random numbers, without one they continue."""

    @abc.abstractmethod
    def advance(self, action: np.ndarray) -> None:
        """Carry out an action, without sensing."""

    @abc.abstractmethod
    def sense(self) -> None:
        """Let the sensors measure; it changes nothing else and may run in another thread."""

    @abc.abstractmethod
    def report(self) -> Report:
        """Return observation, reward, terminated, truncated and info of the last reset or step."""

    @abc.abstractmethod
    def panels(self) -> list[Panel]:
        """Return the images of a picture, from left to right."""

    @abc.abstractmethod
    def captions(self) -> list[Caption]:
        """Return the captions of this environment, which follow those of steps and rewards."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode, and return its first observation and info; see :meth:`begin` for seed and options."""
        self._check_open()
        super().reset(seed=seed)
        self.begin(seed, options)
        self.sense()
        observation, *_, info = self.report()
        self._running, self.tally = True, Tally()
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: np.ndarray) -> Report:
        """Carry out an action; see :meth:`advance`.

        Returns observation, reward, terminated, truncated and info. Raises ``ResetNeeded`` where no episode is under
        way.
        """
        self._check_open()
        if not self._running:
            raise gym.error.ResetNeeded("call reset before step: no episode has begun, or the last one has ended")
        assert self.tally is not None
        self.advance(action)
        self.sense()
        observation, reward, terminated, truncated, info = self.report()
        self._running, self.tally = not (terminated or truncated), self.tally.after(reward, terminated, info)
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return the picture of the present state, uint8 ``(height, width, 3)``; in mode ``human`` show it instead.

        Returns None before the first reset and without ``render_mode``.
        """
        self._check_open()
        if self.render_mode is None or self.tally is None:
            return None
        title, captions = type(self).__name__.removesuffix("Env"), self.tally.captions(self.captions())
        try:
            return self.frames.render(self.panels(), captions, title, self.metadata["render_fps"])
        except SystemExit:  # the user has closed the window
            self.close()
            raise

    def close(self) -> None:
        """Free what the environment holds; it cannot be reset, stepped or rendered afterwards."""
        self._closed = True
        self.frames.close()

    def _check_open(self) -> None:
        if self._closed:
            raise gym.error.ClosedEnvironmentError("the environment is closed: make a new one")


def signature_of(cls: type) -> inspect.Signature:
    """Return the signature of a class with the keywords of the class that it passes the rest to."""
    return inspect.Signature(list(_parameters(cls).values()))


def keywords_of(cls: type) -> list[str]:
    """Return the keywords of a class, and those of the class that it passes the rest to."""
    return list(_parameters(cls))


def _parameters(cls: type) -> dict[str, inspect.Parameter]:
    """Return the parameters of a constructor by name; those of the other class are keywords here."""
    given = inspect.signature(cls.__init__).parameters.items()  # type: ignore[misc]
    rest = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    own = {name: parameter for name, parameter in given if name != "self" and parameter.kind not in rest}
    further = getattr(cls, "passes_to", None)
    if further is None:
        return own
    refused = getattr(cls, "refuses", {})
    return own | {
        name: parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in _parameters(further).items()
        if name not in own and name not in refused
    }
