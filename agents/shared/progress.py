"""Notice that a robot does not get on: an obstacle holds it, or it turns back and forth."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Progress:
    """Compare how far a robot was commanded to drive with how far its estimates have moved.

    Attributes:
        place: ``(2,)`` m, that the robot has not got away from.
        idle: steps that it has driven there.
        blind: steps there that it did not drive because it saw nothing ahead; other attempts do not make it see.
    """

    place: np.ndarray = field(default_factory=lambda: np.full(2, np.inf))
    idle: int = 0
    blind: int = 0
    _last: tuple[float, np.ndarray] | None = None  # the last driving command, m, and where it was given
    _driven: deque[tuple[float, float]] = field(default_factory=deque)  # m commanded and m moved, of recent ones

    def sent(self, step: float, planar: np.ndarray) -> None:
        """Remember a command to drive ``step`` (m) from ``planar``; 0 of one that does not drive."""
        self._last = (step, planar[:2].copy()) if step > 0.0 else None

    def forget(self) -> None:
        """Begin anew: what follows is another attempt."""
        self.idle = 0
        self._last = None
        self._driven.clear()

    def is_held(self, planar: np.ndarray, length: float, share: float) -> bool:
        """Return True where the last ``length`` (m) of commands moved the estimate by less than ``share`` of that."""
        if self._last is not None:
            step, before = self._last
            self._driven.append((step, math.hypot(*(planar[:2] - before))))
        asked, moved = (sum(values) for values in zip(*self._driven, strict=True)) if self._driven else (0.0, 0.0)
        while self._driven and asked - self._driven[0][0] >= length:
            step, away = self._driven.popleft()
            asked, moved = asked - step, moved - away
        return asked >= length and moved < share * asked

    def dithers(self, planar: np.ndarray, away: float, patience: int) -> bool:
        """Return True where the robot drove for more than ``patience`` steps without getting ``away`` (m)."""
        if math.hypot(*(planar[:2] - self.place)) > away:
            self.place, self.idle, self.blind = planar[:2].copy(), 0, 0
        self.idle += 1
        return self.idle > patience
