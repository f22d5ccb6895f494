"""Command a robot through short manoeuvres: turns, its own path backwards, a step to where there is more room."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.shared.following import roomier
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.pursuit import steer

ALIGNED = 0.12  # rad, at which a heading is reached: as much as a turn errs
REACHED = 0.08  # m, at which a place is
RETRACED = 1.5  # m of the path that is driven back at most
PATIENCE = 40  # steps after which a drive ends wherever the robot is: half a turn and twice RETRACED


class Manoeuvre(Protocol):
    """Command a robot until it is done."""

    def command(self, planar: np.ndarray) -> np.ndarray | None:
        """Return ``(turn, o, s)`` at ``planar`` ``(3,)``; None when it is done."""
        ...


@dataclass
class Turn:
    """Turn to headings (rad) one after the other, each the shorter way round."""

    headings: list[float]
    most: float  # rad a step

    def command(self, planar: np.ndarray) -> np.ndarray | None:
        """Return the next turn."""
        while self.headings:
            error = float(wrap_angle(self.headings[0] - planar[2]))
            if abs(error) >= ALIGNED:
                return np.array([math.copysign(min(abs(error), self.most), error), 0.0, 0.0])
            self.headings.pop(0)
        return None


@dataclass
class Nothing:
    """Do nothing: what the response changes is in the plan."""

    def command(self, planar: np.ndarray) -> np.ndarray | None:
        """Return None."""
        return None


@dataclass
class Drive:
    """Drive along places ``(n, 2)``, m, without looking: only where the robot has been, or has seen that it can."""

    places: list[np.ndarray]
    context: AgentContext
    steps: int = 0

    def command(self, planar: np.ndarray) -> np.ndarray | None:
        """Return the next turn or step."""
        while self.places and math.hypot(*(self.places[0] - planar[:2])) <= REACHED:
            self.places.pop(0)
        self.steps += 1
        if not self.places or self.steps > PATIENCE:
            return None
        path, context = np.array([planar[:2], *self.places]), self.context
        return steer(planar, path, context.limits, context.direction_frame)


def around(heading: float, most: float) -> Turn:
    """Return a full turn from ``heading`` (rad) back to it, at ``most`` rad a step."""
    return Turn([float(wrap_angle(heading + turn)) for turn in (2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0, 0.0)], most)


def retraced(track: list[np.ndarray], planar: np.ndarray, context: AgentContext) -> Drive | None:
    """Return the drive back along the poses ``(3,)`` that were believed; None where there are none but here."""
    places, length, last = [], 0.0, planar[:2]
    for pose in reversed(track):
        step = math.hypot(*(pose[:2] - last))
        if step > REACHED:
            places.append(pose[:2].copy())
            length, last = length + step, pose[:2]
        if length > RETRACED:
            break
    return Drive(places, context) if places else None


def back_off(planar: np.ndarray, near: ClearanceMap, length: float, context: AgentContext) -> Drive | None:
    """Return a straight drive of ``length`` (m) to where there is most clearance; None where it falls everywhere."""
    place = roomier(planar, near, length)
    return None if place is None else Drive([place], context)
