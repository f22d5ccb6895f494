"""Notice that a car does not get on: its commands do not move it, or what it has left to drive does not get less."""

from collections import deque
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StuckConfig:
    """Configure when something holds the car: in the last ``steps`` steps, commands one way that add up to ``length``.

    Args:
        steps: of the window.
        recent: the last of these steps, in which the car has hardly moved: those before give its servos time.
        length: m, that the commands have to add up to, all forwards or all backwards: servos lag behind a change.
        share: of what was commanded in the recent steps, below which the car has hardly moved.
    """

    steps: int = 8
    recent: int = 3
    length: float = 0.08
    share: float = 0.25


class Stuck:
    """Compare what a car was commanded with where it was.

    How far it has moved is the largest distance between any two of its recent places: a car that still rolled on as it
    was commanded back ends where it began. What it drives onto unseen it does not feel, so it is not to push for long.
    """

    def __init__(self, config: StuckConfig | None = None) -> None:
        self._config = config or StuckConfig()
        self._motions: deque[tuple[float, np.ndarray]] = deque(maxlen=self._config.steps)

    def step(self, length: float, place: np.ndarray) -> float | None:
        """Return the commanded length (m, signed) that led nowhere; None where the car moves.

        ``length`` was commanded before ``place`` ``(2,)``, m, was reached.
        """
        c = self._config
        self._motions.append((length, np.array(place, np.float64)))
        lengths = np.array([one for one, _ in self._motions][1:])
        places = np.array([where for _, where in self._motions][-c.recent - 1 :])
        asked = float(np.abs(lengths).sum())
        moved = float(np.hypot(*(places[:, None] - places).T).max())
        if len(self._motions) < c.steps or abs(lengths.sum()) < asked:
            return None
        if asked <= c.length or moved >= c.share * float(np.abs(lengths[-c.recent :]).sum()):
            return None
        self.clear()
        return float(lengths.sum())

    def clear(self) -> None:
        """Forget: the car was carried out of a standstill, or its places are not believed."""
        self._motions.clear()


class Progress:
    """Count the steps in a row in which a car drove and its cost-to-go did not fall.

    Not the distance counts, since a turn in many moves stays where it is and a careful car is slow, but the motions
    that are left. When the cost-to-go is computed again, it is compared from there on; the count goes on.
    """

    def __init__(self, least: float) -> None:
        """Count as progress ``least`` motions less than were left before."""
        self._least = least
        self.steps = 0
        self._computed, self._left = -1, np.inf

    def restart(self) -> None:
        """Count from 0; a way that has got longer meanwhile is no progress when it gets shorter again."""
        self.steps = 0

    def see(self, computed: int, left: float) -> None:
        """Take how many motions are left by the cost-to-go of this number."""
        if computed != self._computed:
            self._computed, self._left = computed, left
        elif left < self._left - self._least:
            self.steps, self._left = 0, left

    def drove(self) -> None:
        """Count a step in which the controller drove."""
        self.steps += 1
