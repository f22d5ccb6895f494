"""Follow a way with steps that the noise carries into nothing, and get out of tight spots.

Every step ``s`` is shortened until there is room wherever it may lead: up to ``s + k std`` m ahead, ``k std`` rad off,
with ``k`` of :class:`FollowingConfig`. To the side no more room is asked for than a share of the way's margin: on
narrow ways that is less than ``k`` standard deviations (2 of a full step at a margin of 3 cm and 3 degrees). As the
noise carries the robot off its way, each step pulls what is left of that taut from where it is. A robot that may not
step at all makes room: it goes a little to where there is most.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.grid_search.clearance_requirement import requirement_from
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.pursuit import steer

LEAST_STEP = 0.02  # m, worth its noise
TRIES = 4  # steps that are refused, within ``HELD``, after which a goal is given up
HELD = 0.5  # m
HELD_STEP = 0.15  # m: where nothing else is possible, so far to where there is more room


@dataclass(frozen=True)
class FollowingConfig:
    """How carefully to step; lengths in metres."""

    guard: float = 0.015  # of clearance beyond the radius that a step keeps besides, as far as ``held_share`` lets it
    sigmas: float = 3.5  # of the execution noise that a step is prepared for, where ``held_share`` leaves it the room
    daring: float = 0.8  # by which that shrinks with every step that was refused since the last one
    held_share: float = 0.6  # of the way's margin: more is not asked of a step, or it could not be driven
    lookahead: float = 0.6  # of the way ahead that is checked for something unforeseen at every step


@dataclass(frozen=True)
class PlannedPath:
    """A way and the room that it was planned with.

    Attributes:
        path: ``(n, 2)`` waypoints still to be driven, m, world frame; the first is where the robot is.
        clearance: of the floor plan that it was planned in.
        margin: m of clearance beyond the robot's radius that it keeps.
    """

    path: np.ndarray
    clearance: ClearanceMap
    margin: float


@dataclass(frozen=True)
class Follower:
    """How one robot follows ways; it remembers nothing.

    Attributes:
        radius: of the robot, m.
        limits: ``(3,)`` largest turn (rad), direction offset (rad) and step (m).
        noise: standard deviations of the execution noise: turn (rad), step (m).
        config: how carefully.
    """

    radius: float
    limits: np.ndarray
    noise: tuple[float, float]
    config: FollowingConfig

    @classmethod
    def of(cls, context: AgentContext, config: FollowingConfig) -> "Follower":
        """For the robot of ``context``."""
        return cls(0.5 * context.body_length, context.limits, context.noise, config)

    def shortened(self, way: PlannedPath, planar: np.ndarray) -> PlannedPath | None:
        """The way from where the robot is now, ``(3,)`` m and rad; None where no part of it is in sight."""
        points = np.concatenate([planar[None, :2], way.path[1:]])
        # Never less than a step keeps, or the path would be shortened to where no step may go.
        margin = max(way.margin - 0.015, self.config.guard)
        required = requirement_from(way.clearance, planar[:2], self.radius + margin)
        path = shorten_path(way.clearance, points, way.path[-1], 0.0, required)
        return None if path is None else replace(way, path=path)

    def blocked(self, way: PlannedPath, planar: np.ndarray, near: ClearanceMap) -> bool:
        """Whether something unforeseen stands ahead in ``near``, the clearance as it is known now."""
        least = self.radius + min(0.0, way.margin - 0.02)
        ahead = points_along(way.path, self.config.lookahead)
        return bool(near.at(ahead[1:]).min(initial=math.inf) < min(least, float(near.at(planar[:2])) - 0.01))

    def step(self, way: PlannedPath, planar: np.ndarray, near: ClearanceMap, failures: int) -> np.ndarray:
        """The next command along a way; ``failures`` steps in a row could not be taken before it.

        Returns:
            ``(turn, o, s)``: rad, rad, m; all zero where no step may be taken.
        """
        command = steer(planar, way.path, self.limits)
        return self._careful(way, planar, command, near, failures) if command[2] > 0.0 else command

    def _careful(
        self, way: PlannedPath, planar: np.ndarray, command: np.ndarray, near: ClearanceMap, failures: int
    ) -> np.ndarray:
        """The command with its step shortened so that the noise will not carry the body into anything."""
        c, (turn_std, step_std) = self.config, self.noise
        # Held up again and again, it dares more: what the noise does with small probability only.
        sigmas = c.sigmas * c.daring**failures
        direction = planar[2] + command[1]
        unit = np.array([math.cos(direction), math.sin(direction)])
        spread = math.sin(min(sigmas * turn_std, 0.5 * math.pi))
        far = sigmas * step_std
        t = np.arange(0.01, float(command[2]) + far + 0.005, 0.01)
        asked = self.radius + np.minimum(c.guard + spread * np.maximum(t - far, 0.0), c.held_share * way.margin)
        # A robot that is too near already may go along what it is near to.
        have, here = near.at(planar[:2] + t[:, None] * unit), float(near.at(planar[:2]))
        bad = np.flatnonzero(have < np.minimum(asked, here - 0.004))
        if len(bad) == 0:
            return command
        step = float(t[bad[0]]) - 0.01 - far
        return np.array([0.0, command[1], step]) if step >= LEAST_STEP else np.zeros(3)


@dataclass
class BlockedSteps:
    """Steps that could not be taken around one place."""

    place: np.ndarray = field(default_factory=lambda: np.full(2, np.inf))  # (2,) m, of the first of them
    count: int = 0

    def add(self, xy: np.ndarray) -> bool:
        """One more, at ``xy`` ``(2,)``, m; whether a goal is to be given up for it."""
        if math.hypot(*(xy - self.place)) > HELD:
            self.place, self.count = xy.copy(), 0
        self.count += 1
        return self.count % TRIES == 0


def retreat(way: PlannedPath, planar: np.ndarray, near: ClearanceMap) -> PlannedPath | None:
    """The way of ``HELD_STEP`` straight to where there is most room; None where none keeps as much as here.

    Args:
        way: the one that cannot be driven; the room that is kept stays the same.
        planar: ``(3,)`` the robot's x, y (m) and heading (rad).
        near: clearance as it is known now.
    """
    turns = np.arange(16) * math.pi / 8.0
    away = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    have = np.stack([near.at(planar[:2] + step * away) for step in (0.05, 0.1, HELD_STEP)])
    have[:, have.min(axis=0) < float(near.at(planar[:2]))] = -math.inf
    best = int(np.argmax(have[-1]))
    if not math.isfinite(have[-1, best]):
        return None
    return replace(way, path=np.stack([planar[:2], planar[:2] + HELD_STEP * away[best]]))


def points_along(path: Sequence[np.ndarray] | np.ndarray, length: float, spacing: float = 0.05) -> np.ndarray:
    """Points every ``spacing`` m of a polyline ``(n, 2)``, from its start to ``length`` m on; ``(k, 2)``."""
    path = np.asarray(path)
    edges = np.hypot(*np.diff(path, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(edges)])
    s = np.arange(0.0, min(length, along[-1]) + 1e-9, spacing)
    return np.stack([np.interp(s, along, path[:, a]) for a in (0, 1)], axis=1)
