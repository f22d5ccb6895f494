"""Define what a planner returns: a status with a readable message, a path, its cost and the computing time."""

from dataclasses import dataclass
from enum import Enum

import numpy as np


class Outcome(Enum):
    """Name the outcome of a planner or a solver as a value; each of them defines its outcomes in one subclass."""

    @property
    def message(self) -> str:
        """Return the readable message, which is the value."""
        return str(self.value)


class PlanStatus(Outcome):
    """Name the outcome of a search; the value is the message that reports print."""

    FOUND = "path found"
    NO_PATH = "no path: everything that is free around the start was searched"
    START_BLOCKED = "no path: the start is inside an obstacle, too deep to leave it"
    GOAL_BLOCKED = "no path: no free place within the goal's radius"
    TIME_OUT = "time out: the path leads to the searched place nearest to the goal"


@dataclass(frozen=True)
class PlanResult:
    """Hold a polyline from the start to the goal region, or the reason why there is none.

    Attributes:
        status: how the search ended.
        path: ``(n, 2)`` waypoints in the world frame, metres, the start first; empty ``(0, 2)`` where there is no path,
            the best partial path after a time-out.
        cost: of ``path``: its length in metres where the space has no weight (eq. P2b); infinite without a path.
        seconds: wall-clock time of the whole call.
        expansions: nodes that the search closed.
    """

    status: PlanStatus
    path: np.ndarray
    cost: float
    seconds: float
    expansions: int

    @property
    def found(self) -> bool:
        """Return True if the path ends inside the goal region."""
        return self.status is PlanStatus.FOUND
