"""Explore by the nearest frontier (Yamauchi 1997).

goal = argmin_f d(f)          d: path length to the reachable place nearest to the middle of frontier f

``frontier_nearest`` reads the true pose. Described in ``docs/agents/exploration.md``.
"""

import math

from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.strategy import Choice, Situation, around
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.frontier import frontiers


class NearestFrontier:
    """Choose the nearest frontier, with a full turn at each goal that is reached."""

    def reset(self, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing."""

    def choose(self, situation: Situation) -> Choice | None:
        """Return the goal of the nearest frontier, and a full turn there."""
        found = frontiers(situation.roadmap.plan, situation.roadmap.distance, dismissed=situation.dismissed)
        if not found:
            return None
        best = found[0]
        dx, dy = best.xy.mean(axis=0) - best.goal
        heading = math.atan2(dy, dx)
        return Choice(best.goal, (heading, *around(heading)), best.xy, f"to the nearest of {len(found)} frontiers")


class FrontierNearestAgent:
    """Explore frontiers by distance; the pose is observed."""

    name = "frontier_nearest"
    robot = "holonomic"
    task = "explore"
    needs_pose = True
    needs_map = False

    def __init__(self) -> None:
        self._explorer = Explorer(NearestFrontier())
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
