"""Explore by a random one of the candidate viewpoints of ``mi_explorer``: the ablation of choosing by information.

goal ~ U({q : A(q) >= least area, q not visited})          A: expected unknown area in sight of a candidate, m^2

``random_viewpoint`` reads the true pose. Described in ``docs/agents/exploration.md``.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.exploration.mi_explorer import MiExplorerConfig
from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.strategy import Choice, Situation, around
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.building_prior import expected_surfaces
from vssm_gym.planning.exploration.candidates import candidates


@dataclass(frozen=True)
class RandomViewpointConfig:
    """Configure ``random_viewpoint``; the candidates are those of ``mi_explorer``."""

    spacing: float = MiExplorerConfig.spacing  # m between candidates
    hazard: tuple[float, float] = MiExplorerConfig.hazard  # 1/m, of surfaces in unknown space
    least_area: float = MiExplorerConfig.least_area  # m^2 of unknown space in sight
    same_place: float = MiExplorerConfig.same_place  # m; a place so near to one that was visited counts as visited


class RandomViewpoint:
    """Choose a candidate viewpoint at random, and keep it until it is reached."""

    def __init__(self, config: RandomViewpointConfig) -> None:
        self._config = config

    def reset(self, seed: int) -> None:
        """Open an episode whose draws follow from ``seed``."""
        self._rng = np.random.default_rng(seed)
        self._goal: np.ndarray | None = None
        self._visited: list[np.ndarray] = []  # goals that were reached, m

    def choose(self, situation: Situation) -> Choice | None:
        """Return the goal of before until it is reached, then another; None where there is none."""
        if situation.arrived and self._goal is not None:
            if math.hypot(*(self._goal - situation.planar[:2])) < self._config.same_place:
                self._visited.append(self._goal)
            self._goal = None
        c = self._config
        hazard = expected_surfaces(situation.roadmap.plan, *c.hazard)
        found = candidates(
            situation.roadmap, spacing=c.spacing, hazard=hazard, least_area=c.least_area, dismissed=situation.dismissed
        )
        visited = np.reshape(self._visited, (-1, 2))
        gap = np.linalg.norm(found.xy[:, None] - visited[None], axis=-1)
        # Gain that is still expected at a visited place cannot be observed from it.
        xy = found.xy[gap.min(axis=1, initial=np.inf) >= c.same_place]
        if not len(xy):
            return None
        if self._goal is None or not situation.roadmap.reaches(self._goal):
            self._goal = xy[self._rng.integers(len(xy))]
        return Choice(self._goal, around(situation.planar[2]), None, f"to one of {len(xy)} candidates")


class RandomViewpointAgent:
    """Explore by random candidate viewpoints; the pose is observed."""

    name = "random_viewpoint"
    robot = "holonomic"
    task = "explore"
    needs_pose = True
    needs_map = False

    def __init__(self, config: RandomViewpointConfig | None = None) -> None:
        self._explorer = Explorer(RandomViewpoint(config or RandomViewpointConfig()))
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
