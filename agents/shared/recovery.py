"""Respond to what goes wrong on the way: a table of failures, each with its responses in order.

A failure is met by the first response of its row, and by the next one if it is still there, or there again before the
robot has come :data:`PROGRESS` further. Where a row has ended, the robot gives up. Every response that begins is
counted.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from vssm_gym.agents.shared.manoeuvres import Manoeuvre, Nothing

PROGRESS = 1.0  # m from where a failure was met, after which its row begins anew


class Failure(Enum):
    """Enumerate what goes wrong."""

    LOST = "lost"  # images do not fit where the robot believes to be
    UNCERTAIN = "uncertain"  # they fit, but they do not say where along a wall or corridor
    STUCK = "stuck"  # it does not get away from a place
    BLOCKED = "blocked"  # no step along the path is free
    NO_PATH = "no path"


class Response(Enum):
    """Enumerate what the robot does about it."""

    LOOK_BACK = "looks back"  # turns to where it knew its pose last
    TURN_AROUND = "turns around"
    RETRACE = "retraces its path"
    BACK_OFF = "backs off"  # moves to where there is more room, and plans around what it met
    LOOK_AGAIN = "looks again"  # forgets the obstacles nearby that it saw from nearby, and turns around
    EXPLORE = "explores"  # drives to the frontier that is nearest on the way to the goal
    GO_ON = "goes on"


Table = Mapping[Failure, tuple[Response, ...]]

IN_KNOWN_MAP: Table = {
    Failure.LOST: (Response.LOOK_BACK, Response.TURN_AROUND, Response.RETRACE, Response.TURN_AROUND),
    Failure.UNCERTAIN: (Response.LOOK_BACK, Response.TURN_AROUND, Response.GO_ON),
    Failure.STUCK: (Response.BACK_OFF, Response.BACK_OFF, Response.RETRACE, Response.BACK_OFF, Response.RETRACE),
    Failure.BLOCKED: (Response.BACK_OFF, Response.BACK_OFF, Response.RETRACE, Response.BACK_OFF),
    Failure.NO_PATH: (Response.TURN_AROUND, Response.LOOK_AGAIN),
}
IN_OWN_MAP: Table = {
    **IN_KNOWN_MAP,
    Failure.STUCK: (Response.BACK_OFF, Response.BACK_OFF, Response.LOOK_AGAIN, Response.BACK_OFF, Response.RETRACE),
    Failure.BLOCKED: (Response.BACK_OFF, Response.LOOK_AGAIN, Response.BACK_OFF, Response.RETRACE),
    Failure.NO_PATH: (Response.TURN_AROUND, Response.LOOK_AGAIN, Response.EXPLORE, Response.LOOK_AGAIN),
}
WITHOUT_IMAGES: Table = {**IN_KNOWN_MAP, Failure.UNCERTAIN: ()}  # no view makes such an estimate more certain
WITHOUT: Table = dict.fromkeys(Failure, ())  # of the ablation: a failure ends the task, but an uncertain estimate


@dataclass
class Recovery:
    """Keep how far each failure's row of responses has come in a task, and count the responses."""

    table: Table
    counts: Counter[str] = field(default_factory=Counter)
    of: Failure | None = None  # that the running manoeuvre responds to
    activity: str = "looking around first"
    manoeuvre: Manoeuvre = field(default_factory=Nothing)
    _interrupted: tuple[Failure | None, str, Manoeuvre] | None = None  # goes on when the robot knows its pose again
    _resumed: Manoeuvre | None = None  # has gone on once, and does not again
    _next: dict[Failure, int] = field(default_factory=dict)
    _place: dict[Failure, np.ndarray] = field(default_factory=dict)

    def response(self, failure: Failure, planar: np.ndarray) -> Response | None:
        """Return the next response of a failure's row at ``planar``; None where the row has ended."""
        place = self._place.get(failure)
        if place is None or math.hypot(*(planar[:2] - place)) > PROGRESS:
            self._place[failure], self._next[failure] = planar[:2].copy(), 0
        k = self._next[failure]
        if k >= len(self.table[failure]):
            return None
        self._next[failure] = k + 1
        return self.table[failure][k]

    def begin(self, failure: Failure, response: Response, manoeuvre: Manoeuvre) -> None:
        """Run a manoeuvre in the steps to come; one that a lost robot had begun is kept."""
        if failure is Failure.LOST and self.of is not Failure.LOST and self.manoeuvre is not self._resumed:
            self._interrupted = self.of, self.activity, self.manoeuvre
        self.of, self.manoeuvre = failure, manoeuvre
        self.activity = f"looking around: {failure.value}: {response.value}"

    def end(self) -> None:
        """Run no manoeuvre."""
        self.of, self.manoeuvre = None, Nothing()

    def found(self) -> None:
        """End the response to being lost, and go on with what it interrupted; once."""
        self.end()
        if self._interrupted is not None:
            self.of, self.activity, self.manoeuvre = self._interrupted
            self._interrupted, self._resumed = None, self.manoeuvre

    def overcome(self, failure: Failure) -> None:
        """Begin the row of a failure anew when it comes again."""
        self._place.pop(failure, None)
