"""Explore by a random walk: straight in a random direction as far as it is free, again and again; the lower bound.

goal = xy + s (cos a, sin a),  a ~ U(-pi, pi),  s ~ U(least, most), shortened to what is free

``random_walk`` reads the true pose. Described in ``docs/agents/exploration.md``.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.strategy import Choice, Situation
from vssm_gym.maps.voxel_map import VoxelMap


@dataclass(frozen=True)
class RandomWalkConfig:
    """Configure ``random_walk``."""

    least: float = 0.5  # m, of a leg as it is drawn
    most: float = 3.0
    tries: int = 50  # draws, after which the longest free leg is taken, however short


class RandomLegs:
    """Choose legs at random, as long as one leads anywhere."""

    def __init__(self, config: RandomWalkConfig) -> None:
        self._config = config

    def reset(self, seed: int) -> None:
        """Open an episode whose draws follow from ``seed``."""
        self._rng = np.random.default_rng(seed)
        self._goal: np.ndarray | None = None

    def choose(self, situation: Situation) -> Choice | None:
        """Return the end of the present leg, or of a new one; None where no leg leads anywhere."""
        if self._goal is None or situation.arrived or not situation.roadmap.reaches(self._goal):
            self._goal = self._drawn(situation)
        if self._goal is None:
            return None
        return Choice(self._goal, (), None, "walks at random")

    def _drawn(self, situation: Situation) -> np.ndarray | None:
        c, xy, longest, best = self._config, situation.planar[:2], -1.0, None
        for _ in range(c.tries):
            angle, length = self._rng.uniform(-math.pi, math.pi), self._rng.uniform(c.least, c.most)
            s = np.arange(0.1, length + 1e-9, 0.05)
            leg = xy + s[:, None] * np.array([math.cos(angle), math.sin(angle)])
            free = np.isfinite(situation.roadmap.at(situation.roadmap.distance, leg))
            # Near an obstacle the first steps may have less clearance than a path needs.
            blocked = np.flatnonzero(~free & (s > 0.3))
            n = int(blocked[0]) if len(blocked) else len(s)
            if n and free[n - 1] and s[n - 1] > longest:
                longest, best = float(s[n - 1]), leg[n - 1]
            if longest >= c.least:
                break
        return best


class RandomWalkAgent:
    """Explore by a random walk; the pose is observed."""

    name = "random_walk"
    robot = "holonomic"
    task = "explore"
    needs_pose = True
    needs_map = False

    def __init__(self, config: RandomWalkConfig | None = None) -> None:
        self._explorer = Explorer(RandomLegs(config or RandomWalkConfig()))
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
