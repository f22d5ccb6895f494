"""Say how a run of navigation ended, and where its goal was, for its pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

GOOD, BAD, NEUTRAL = "#0b6e4f", "#b3261e", "black"  # colours of an ending


@dataclass(frozen=True)
class Ending:
    """Hold the outcome of a run.

    Attributes:
        goal: xy, m; None where nobody knows it, because the goal was given as an image.
        success_radius: around the goal, m.
        success: whether the run succeeded; None where that cannot be judged.
        reason: why it failed; empty of others.
    """

    goal: tuple[float, float] | None
    success_radius: float
    success: bool | None
    reason: str

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> "Ending":
        """Read the ending from a row of a sweep, whose judged fields may be None."""
        success = row["success"]
        goal = None if row["goal"] is None else (float(row["goal"][0]), float(row["goal"][1]))
        return cls(goal, float(row["success_radius"]), success, "" if success in (None, True) else str(row["failure"]))

    @property
    def word(self) -> str:
        """Return the outcome in a word or two."""
        return "not judged" if self.success is None else "arrived" if self.success else "failed"

    @property
    def colour(self) -> str:
        """Return the colour of the word."""
        return NEUTRAL if self.success is None else GOOD if self.success else BAD

    @property
    def region(self) -> list[Float[np.ndarray, "2 2"]]:
        """Return the box of the success region, ``(2, 2)`` m, as the only item of a list; none without a goal."""
        if self.goal is None:
            return []
        centre = np.array(self.goal)
        return [np.stack([centre - self.success_radius, centre + self.success_radius])]
