"""Explore a maze at random: straight ahead until something is near, then in a random direction that is free.

``maze_random`` reads the scan alone and keeps neither pose nor map. Described in ``docs/agents/exploration.md``.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.planar.driving import ALIGNED_ENOUGH, free_ahead
from vssm_gym.geometry.transforms import wrap_angle


@dataclass(frozen=True)
class MazeRandomConfig:
    """Configure ``maze_random``."""

    margin: float = 0.003  # m beyond the robot's radius that must be free ahead
    longest: float = 0.5  # m of a leg, at most
    tries: int = 50  # directions that are drawn before it only turns


class MazeRandomAgent:
    """Drive legs in random directions."""

    name = "maze_random"
    robot = "disc"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: MazeRandomConfig | None = None) -> None:
        self._config = config or MazeRandomConfig()

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode whose draws follow from ``seed``."""
        del observation
        self._rng = np.random.default_rng(seed)
        self._limits = np.asarray(context.limits, np.float64)
        self._half_width = 0.5 * context.body_length + self._config.margin
        self._left, self._off = 0.0, 0.0  # m of the leg still to be driven; rad still to be turned before

    def act(self, observation: Observation) -> Decision:
        """Turn to the leg's direction, or drive along it; draw another one where it is over or blocked."""
        scan = np.asarray(observation["scan"], np.float64)
        turn, step = float(self._limits[0]), float(self._limits[1])
        if abs(self._off) <= ALIGNED_ENOUGH and (self._left <= 0.0 or free_ahead(scan, 0.0, self._half_width) < step):
            self._draw(scan, step)
        command = np.array([np.clip(self._off, -turn, turn), 0.0])
        if abs(self._off) <= ALIGNED_ENOUGH and free_ahead(scan, 0.0, self._half_width) >= step:
            command[1] = step
            self._left -= step
        self._off = float(wrap_angle(self._off - command[0]))
        return Decision(np.array([*command, 0.0], np.float32), None, "drives at random")

    def _draw(self, scan: np.ndarray, step: float) -> None:
        """Draw the direction and the length of the next leg, which is free for two steps at least."""
        for _ in range(self._config.tries):
            self._off = float(self._rng.uniform(-math.pi, math.pi))
            self._left = float(self._rng.uniform(2.0 * step, self._config.longest))
            if free_ahead(scan, self._off, self._half_width) >= 2.0 * step:
                return
