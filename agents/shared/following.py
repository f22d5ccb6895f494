"""Follow a path by steps that stay free under the execution noise, and leave tight spots.

Every step ``s`` is shortened until there is room wherever it may lead: up to ``s + k std`` m ahead, ``k std`` rad off,
with ``k`` of :class:`FollowingConfig`. To the side, at most a fraction of the path's margin is asked for. On narrow
paths that is less than ``k`` standard deviations (2 of a full step at a margin of 3 cm and 3 degrees). As the noise
carries the robot off its path, each step shortens what is left of the path from where the robot is. A robot that may
not step at all retreats: it moves a little to where there is most clearance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.geometry.axes import DirectionFrame
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.grid_search.clearance_requirement import requirement_from
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.pursuit import BEND_PASSED, direction_of_travel, steer

CERTAIN = np.zeros(3)  # standard deviations of a pose that is observed


@dataclass(frozen=True)
class FollowingConfig:
    """Configure how carefully to step; lengths in metres."""

    guard: float = 0.015  # clearance beyond the radius that a step also keeps, as far as ``held_share`` allows
    sigmas: float = 3.5  # standard deviations of the execution noise that stay free, as far as ``held_share`` allows
    daring: float = 0.8  # factor by which ``sigmas`` shrinks with every blocked step since the last one that was taken
    held_share: float = 0.6  # fraction of the path's margin that a step must keep at most; with all of it, none is free
    lookahead: float = 0.6  # length of path ahead that is checked for unforeseen obstacles at every step
    least_step: float = 0.02  # a shorter step would add more noise than progress
    tries: int = 4  # blocked steps within ``blocked_radius`` after which a goal is given up
    blocked_radius: float = 0.5
    bend_passed: float = BEND_PASSED  # distance at which a bend counts as passed
    arc: float = 0.0  # rad off its path, up to which the robot drives as it turns; 0: it turns in place
    retreat: float = 0.15  # length of the step to where there is more room, when no other step is possible


@dataclass(frozen=True)
class PlannedPath:
    """Hold a path and the clearance that it was planned with.

    Attributes:
        path: ``(n, 2)`` waypoints still to be driven, m, world frame; the first is where the robot is.
        clearance: of the floor plan that it was planned in.
        margin: m of clearance beyond the robot's radius that the path keeps.
    """

    path: np.ndarray
    clearance: ClearanceMap
    margin: float


@dataclass(frozen=True)
class Follower:
    """Follow paths with one robot; a follower has no state.

    Attributes:
        radius: of the robot, m.
        limits: ``(3,)`` largest turn (rad), direction (rad) and step (m).
        noise: standard deviations of the execution noise: turn (rad), step (m).
        config: how carefully to step.
        direction_frame: of the commands.
    """

    radius: float
    limits: np.ndarray
    noise: tuple[float, float]
    config: FollowingConfig
    direction_frame: DirectionFrame = "body"

    @classmethod
    def of(cls, context: AgentContext, config: FollowingConfig) -> "Follower":
        """Make a follower for the robot of ``context``."""
        return cls(0.5 * context.body_length, context.limits, context.noise, config, context.direction_frame)

    def shortened(self, planned: PlannedPath, planar: np.ndarray) -> PlannedPath | None:
        """Return the path from where the robot is now, ``(3,)`` m and rad; None where no part of it can be reached."""
        points = np.concatenate([planar[None, :2], planned.path[1:]])
        # Never less than a step keeps, or the path would be shortened to where no step may go.
        margin = max(planned.margin - 0.015, self.config.guard)
        required = requirement_from(planned.clearance, planar[:2], self.radius + margin)
        path = shorten_path(planned.clearance, points, planned.path[-1], 0.0, required)
        return None if path is None else replace(planned, path=path)

    def blocked(self, planned: PlannedPath, planar: np.ndarray, near: ClearanceMap) -> bool:
        """Return True where ``near``, the clearance as it is known now, shows an unforeseen obstacle ahead."""
        least = self.radius + min(0.0, planned.margin - 0.02)
        ahead = points_along(planned.path, self.config.lookahead)
        return bool(near.at(ahead[1:]).min(initial=math.inf) < min(least, float(near.at(planar[:2])) - 0.01))

    def step(
        self,
        planned: PlannedPath,
        planar: np.ndarray,
        near: ClearanceMap,
        failures: float,
        std: np.ndarray = CERTAIN,
        exact: bool = False,
    ) -> np.ndarray:
        """Return the next command along a path.

        Args:
            planned: the path.
            planar: ``(3,)`` where the robot is, m and rad.
            near: clearance as it is known now.
            failures: steps in a row that could not be taken before it.
            std: ``(3,)`` standard deviations of ``planar`` against the map, m and rad.
            exact: whether to take each bend, however near.

        Returns:
            ``(turn, o, s)``: rad, rad, m; all zero where no step may be taken.
        """
        passed = BEND_PASSED if exact else self.config.bend_passed
        command = steer(planar, planned.path, self.limits, self.direction_frame, passed)
        if command[2] == 0.0 and (arc := self._arc(command, planned.path, planar)) is not None:
            turn, careful = command[0], self._careful(planned, planar, arc, near, failures, std)
            return np.array([turn, *careful[1:]]) if careful[2] > 0.0 else command
        return self._careful(planned, planar, command, near, failures, std) if command[2] > 0.0 else command

    def _arc(self, command: np.ndarray, path: np.ndarray, planar: np.ndarray) -> np.ndarray | None:
        """Return a turn in place with a step ahead; None where the robot looks too far off, or the bend is too near."""
        max_turn, max_offset, max_step = self.limits
        to = path[1:] - planar[:2]
        far = np.flatnonzero(np.hypot(*to.T) > BEND_PASSED)
        if not (command[0] and len(far)):
            return None
        x, y = to[far[0]]
        off = float(wrap_angle(math.atan2(y, x) - planar[2]))
        # A step s saves s cos(off) / max_step steps of driving, and costs s sin(off) / (distance max_turn) of turning.
        if abs(off) > self.config.arc or math.hypot(x, y) * max_turn < max_step * math.tan(abs(off)):
            return None
        step = min(max_step, math.hypot(x, y)) * math.cos(off)
        return np.array([command[0], math.copysign(max_offset, off), step])

    def _careful(
        self,
        planned: PlannedPath,
        planar: np.ndarray,
        command: np.ndarray,
        near: ClearanceMap,
        failures: float,
        std: np.ndarray,
    ) -> np.ndarray:
        """Shorten the step of a command so that the noise does not carry the body into an obstacle."""
        c, (turn_std, step_std) = self.config, self.noise
        # Blocked again and again, the robot accepts what the noise does with small probability only.
        sigmas = c.sigmas * c.daring**failures
        direction = direction_of_travel(planar, command, self.direction_frame)
        unit = np.array([math.cos(direction), math.sin(direction)])
        spread = math.sin(min(sigmas * math.hypot(turn_std, std[2]), 0.5 * math.pi))
        guard = c.guard + sigmas * float(np.max(std[:2]))
        far = sigmas * step_std
        t = np.arange(0.01, float(command[2]) + far + 0.005, 0.01)
        asked = self.radius + np.minimum(guard + spread * np.maximum(t - far, 0.0), c.held_share * planned.margin)
        # A robot that is too near to an obstacle already may move along it.
        have, here = near.at(planar[:2] + t[:, None] * unit), float(near.at(planar[:2]))
        bad = np.flatnonzero(have < np.minimum(asked, here - 0.004))
        if len(bad) == 0:
            return command
        step = float(t[bad[0]]) - 0.01 - far
        # A step that ends before the bend does not turn yet; in the world frame the robot turns to where it drives.
        turn = 0.0 if self.direction_frame == "body" else float(command[0])
        return np.array([turn, command[1], step]) if step >= c.least_step else np.zeros(3)


@dataclass
class BlockedSteps:
    """Count the steps that could not be taken around one place."""

    config: FollowingConfig
    place: np.ndarray = field(default_factory=lambda: np.full(2, np.inf))  # (2,) m, of the first of them
    count: int = 0

    def add(self, xy: np.ndarray) -> bool:
        """Count one more at ``xy`` ``(2,)``, m; return True where the goal is to be given up."""
        if math.hypot(*(xy - self.place)) > self.config.blocked_radius:
            self.place, self.count = xy.copy(), 0
        self.count += 1
        return self.count % self.config.tries == 0


def roomier(planar: np.ndarray, near: ClearanceMap, length: float) -> np.ndarray | None:
    """Return the place ``(2,)`` with most clearance, ``length`` (m) straight away; None where it falls along each step.

    Args:
        planar: ``(3,)`` the robot's x, y (m) and heading (rad).
        near: clearance as it is known now.
        length: of the step, m.
    """
    turns = np.arange(16) * math.pi / 8.0
    away = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    have = np.stack([near.at(planar[:2] + step * away) for step in (0.05, 0.1, length)])
    have[:, have.min(axis=0) < float(near.at(planar[:2]))] = -math.inf
    best = int(np.argmax(have[-1]))
    return planar[:2] + length * away[best] if math.isfinite(have[-1, best]) else None


def points_along(path: Sequence[np.ndarray] | np.ndarray, length: float, spacing: float = 0.05) -> np.ndarray:
    """Return points every ``spacing`` m along a polyline ``(n, 2)``, over its first ``length`` m; ``(k, 2)``."""
    path = np.asarray(path)
    edges = np.hypot(*np.diff(path, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(edges)])
    s = np.arange(0.0, min(length, along[-1]) + 1e-9, spacing)
    return np.stack([np.interp(s, along, path[:, a]) for a in (0, 1)], axis=1)
