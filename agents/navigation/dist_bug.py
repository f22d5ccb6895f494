"""Drive at the goal, follow walls around obstacles, and leave them nearer to the goal than they were met.

``dist_bug`` is DistBug (Kamon and Rivlin, 1997) for a disc with a laser scanner. It reads ranges and knows its start,
the goal and its own commands, from which it integrates its pose: the error grows with the noise of every step. It has
no map. Described in ``docs/agents/navigation.md``.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.geometry.transforms import wrap_angle


@dataclass(frozen=True)
class DistBugConfig:
    """Configure ``dist_bug``; lengths in metres."""

    margin: float = 0.003  # beyond the robot's radius by which a direction must be free
    steps_free: float = 2.0  # full steps that a direction must be free to be taken
    aligned: float = math.radians(12.0)  # heading error up to which the robot drives while it turns
    back: float = math.radians(120.0)  # from the last direction towards the wall, where the next search begins
    arrived: float = 0.3  # fraction of the success radius within which it stops


class DistBugAgent:
    """Drive in two modes: ``to the goal`` while that direction is free, ``along a wall`` while it is not."""

    name = "dist_bug"
    robot = "disc"
    task = "pointgoal"
    needs_pose = False
    needs_map = False

    def __init__(self, config: DistBugConfig | None = None) -> None:
        self._config = config or DistBugConfig()

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode at the start pose; nothing is random."""
        del observation, seed
        self._limits = np.asarray(context.limits, np.float64)
        self._near = self._config.arrived * context.success_radius
        self._half_width = 0.5 * context.body_length + self._config.margin
        self._planar = np.asarray(context.start_pose, np.float64).copy()
        self._side = 0  # 0: to the goal; 1: along a wall on the right, which is turned away from to the left; -1: left
        self._heading = 0.0  # world direction of the last choice
        self._hit = math.inf  # m to the goal where the wall was met

    def act(self, observation: Observation) -> Decision:
        """Choose a direction; turn to it, or drive where it is ahead."""
        to_goal = np.asarray(observation["goal"], np.float64) - self._planar[:2]
        distance = float(np.hypot(*to_goal))
        if distance <= self._near:
            return self._decision(0.0, 0.0, stop=True, status="arrived")
        turn, step = self._limits
        direction = self._direction(np.asarray(observation["scan"], np.float64), to_goal, distance)
        if direction is None:
            return self._decision(turn, 0.0, stop=False, status="boxed in: turns")
        self._heading = direction
        off = wrap_angle(direction - self._planar[2])
        drives = abs(off) <= self._config.aligned
        status = "to the goal" if self._side == 0 else "along a wall"
        return self._decision(
            float(np.clip(off, -turn, turn)), min(step, distance) if drives else 0.0, stop=False, status=status
        )

    def _direction(self, scan: np.ndarray, to_goal: np.ndarray, distance: float) -> float | None:
        """Return the world direction (rad) to drive in; None where none is free."""
        bearing = math.atan2(to_goal[1], to_goal[0])
        need = self._config.steps_free * self._limits[1]
        open_to_goal = self._free(scan, bearing) >= min(distance, need)
        if self._side == 0:
            if open_to_goal:
                return bearing
            found = {side: self._sweep(scan, bearing, side, need) for side in (1, -1)}
            turns = {side: abs(wrap_angle(angle - bearing)) for side, angle in found.items() if angle is not None}
            if not turns:
                return None
            self._side, self._hit = min(turns, key=lambda side: turns[side]), distance
            return found[self._side]
        if open_to_goal and distance < self._hit - self._limits[1]:
            self._side = 0
            return bearing
        return self._sweep(scan, self._heading - self._side * self._config.back, self._side, need)

    def _sweep(self, scan: np.ndarray, start: float, side: int, need: float) -> float | None:
        """Return the first direction from ``start`` on, counter-clockwise for side 1, that is free for ``need`` m."""
        for angle in np.arange(0.0, 2.0 * math.pi, math.radians(5.0)):
            if self._free(scan, start + side * angle) >= need:
                return float(wrap_angle(start + side * angle))
        return None

    def _free(self, scan: np.ndarray, direction: float) -> float:
        """Return the length (m) that the disc can drive in a world direction before it meets a measured point."""
        read = scan > 0.0  # 0: no measurement
        angles = self._planar[2] + 2.0 * np.pi * np.arange(len(scan))[read] / len(scan) - direction
        ahead, beside = scan[read] * np.cos(angles), np.abs(scan[read] * np.sin(angles))
        met = (beside < self._half_width) & (ahead > 0.0)
        reach = ahead[met] - np.sqrt(np.maximum(0.0, self._half_width**2 - beside[met] ** 2))
        return float(reach.min(initial=np.inf))

    def _decision(self, turn: float, step: float, *, stop: bool, status: str) -> Decision:
        """Return the command with the estimate before it, and advance the estimate by the command."""
        believed = self._planar.copy()
        self._planar[:2] += step * np.array([math.cos(believed[2]), math.sin(believed[2])])
        self._planar[2] = wrap_angle(believed[2] + turn)
        return Decision(np.array([turn, step, float(stop)], np.float32), believed, status)
