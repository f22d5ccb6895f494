"""Respond to the failures of a car that maps as it drives, by a table: failure -> responses, one after the other.

A car cannot look around where it stands. What it knows to be free is the path that it came: it backs up along it, to
places from which it has seen more, and creeps where it has no path.
"""

from collections import Counter
from enum import Enum

import numpy as np

from vssm_gym.geometry.arc import arc_between, poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena, collides, overlaps

BACK_SPEED = 0.25  # m/s, along the path that it came
CREEP_SPEED = 0.15  # m/s
CREEP_LENGTH = 0.15  # m that have to be free where it creeps
BACK_REACH = 0.1  # m that have to be free where it backs up
REMEMBERED = 120  # pieces of its path that it can drive back along: 3 m
LEAST, JUMP = 0.01, 0.15  # m from pose to pose: a shorter way is not recorded yet, a longer one was not driven


class Failure(Enum):
    """Enumerate what stops a car."""

    LOST = "its image does not fit its map"
    BLIND = "its image holds hardly any depth"
    FROZEN = "its camera is frozen"
    REPEATED = "its image repeats itself"
    UNCONFIRMED = "its image fits again, for less than three steps"
    STUCK = "it does not move"
    HELD = "its plan leads nowhere"
    UNSEEN = "its path leads where it cannot look"
    NO_PATH = "no path leads to the target"


class Response(Enum):
    """Enumerate what it does about it."""

    DRIVE = "drives"
    BRAKE = "brakes"
    BACK_UP = "backs up along its path"
    CREEP = "creeps"
    GIVE_UP = "gives up"


WITHOUT_POSE = (Failure.LOST, Failure.BLIND, Failure.FROZEN, Failure.REPEATED, Failure.UNCONFIRMED)
LASTING = (*WITHOUT_POSE, Failure.NO_PATH)
# Responses and how many steps each lasts. Those of a lasting failure end with it; the others are carried out.
RESPONSES: dict[Failure, tuple[tuple[Response, int], ...]] = {
    Failure.LOST: (
        (Response.BRAKE, 4),
        (Response.BACK_UP, 16),
        (Response.BRAKE, 4),
        (Response.CREEP, 10),
        (Response.BRAKE, 4),
        (Response.BACK_UP, 26),
        (Response.GIVE_UP, 1),
    ),
    Failure.BLIND: ((Response.BRAKE, 2), (Response.BACK_UP, 40), (Response.BRAKE, 10), (Response.GIVE_UP, 1)),
    Failure.FROZEN: ((Response.BRAKE, 64), (Response.GIVE_UP, 1)),
    Failure.REPEATED: ((Response.CREEP, 20), (Response.BACK_UP, 40), (Response.GIVE_UP, 1)),
    Failure.UNCONFIRMED: ((Response.BRAKE, 64), (Response.GIVE_UP, 1)),
    Failure.STUCK: ((Response.BRAKE, 1), (Response.BACK_UP, 12)),
    Failure.HELD: ((Response.BACK_UP, 8), (Response.BRAKE, 1)),
    Failure.UNSEEN: ((Response.BRAKE, 1),),
    Failure.NO_PATH: (
        (Response.BRAKE, 12),
        (Response.BACK_UP, 16),
        (Response.BRAKE, 12),
        (Response.CREEP, 10),
        (Response.BRAKE, 20),
        (Response.GIVE_UP, 1),
    ),
}


class Recovery:
    """Walk through the table. ``counts`` says how often each response has begun, by name.

    A lasting failure that another one interrupts goes on where it was: two that alternate would otherwise begin anew
    for ever. Those of a car that is lost are forgotten once it is not lost, and all of them once nothing is wrong.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.failure: Failure | None = None
        self._steps: Counter[Failure] = Counter()  # that each failure has been responded to

    def step(self, failure: Failure | None) -> Response:
        """Return the response of this step to what is wrong now; None: nothing is."""
        if failure not in WITHOUT_POSE:
            for past in WITHOUT_POSE if failure else LASTING:
                self._steps.pop(past, None)
        lasting = self.failure in LASTING
        if failure is not self.failure and (self.failure is None or lasting or failure in LASTING):
            self.failure = failure
            if failure is not None and failure not in LASTING:
                self._steps.pop(failure, None)
        if self.failure is None:
            return Response.DRIVE
        ends = np.cumsum([steps for _, steps in RESPONSES[self.failure]])
        stage = int(np.searchsorted(ends, self._steps[self.failure], side="right"))
        if stage == len(ends):
            self.failure = None
            return Response.DRIVE
        response = RESPONSES[self.failure][stage][0]
        if self._steps[self.failure] == (ends[stage - 1] if stage else 0):
            self.counts[response.value] += 1
        self._steps[self.failure] += 1
        return response


class Trail:
    """Remember the arcs that a car has driven, to drive back along them.

    They join poses that it has had by its estimate, not its commands: a car that is held has not driven these.
    """

    def __init__(self, car: Car, planar: np.ndarray) -> None:
        self._car = car
        self._last = np.array(planar, np.float64)  # where the newest piece ends
        self._arcs: list[tuple[float, float]] = []  # m, signed, and the steering

    def drove(self, planar: np.ndarray) -> None:
        """Add the arc to where the car is now (m, rad); its pieces are no longer than one step back."""
        chord = float(np.hypot(*(planar[:2] - self._last[:2])))
        if chord < LEAST:
            return
        if chord <= JUMP:  # or it is one of the estimate
            length, steering = arc_between(self._last, planar, self._car.wheelbase)
            steering = float(np.clip(steering, -self._car.max_steering, self._car.max_steering))
            count = int(np.ceil(abs(length) / (BACK_SPEED * self._car.dt) - 1e-6))
            self._arcs = [*self._arcs, *[(length / count, steering)] * count][-REMEMBERED:]
        self.begin(planar)

    def begin(self, planar: np.ndarray) -> None:
        """Go on from here (m, rad): what lies between is no piece, as the car drove back along the path."""
        self._last = np.array(planar, np.float64)

    def back(self) -> np.ndarray | None:
        """Return the command that undoes the newest piece; None where there is none."""
        if not self._arcs:
            return None
        length, steering = self._arcs[-1]
        return np.array([-length / self._car.dt, steering])

    def undo(self) -> None:
        """Forget the newest piece: the command that undoes it is executed."""
        self._arcs.pop()


def creeping(arena: Arena, planar: np.ndarray, car: Car) -> np.ndarray:
    """Return a slow command along the first short arc that is free, ahead before back; a stand where none is."""
    for sign in (1.0, -1.0):
        for steering in car.max_steering * np.array([0.0, 0.5, -0.5, 1.0, -1.0]):
            lengths = sign * CREEP_LENGTH * np.array([0.35, 0.7, 1.0])
            poses = poses_after(planar[2], lengths, turn_of(lengths, steering, car.wheelbase), *planar[:2])
            if not any(collides(arena, pose, car) for pose in poses):
                return np.array([sign * CREEP_SPEED, steering])
    return np.zeros(2)


def leads_into(
    cells: np.ndarray,
    origin: np.ndarray,
    resolution: float,
    planar: np.ndarray,
    command: np.ndarray,
    car: Car,
    reach: float = BACK_REACH,
) -> bool:
    """Return True where a command leads onto cells that are set within ``reach`` (m), from where none is.

    Its path was free as the car came; the map that it has by now may say otherwise, and the car is not quite on it.
    ``cells`` as of :func:`~vssm_gym.planning.car.footprint.overlaps`.
    """
    lengths = np.copysign(reach, command[0]) * np.array([0.0, 0.5, 1.0])
    poses = poses_after(planar[2], lengths, turn_of(lengths, float(command[1]), car.wheelbase), *planar[:2])
    meets = [overlaps(cells, origin, resolution, pose, car) for pose in poses]
    return not meets[0] and any(meets)
