"""Choose places to drive to, one after the other, from which a growing map gains most, until none is left.

An :class:`~vssm_gym.agents.shared.strategy.ExplorationStrategy` makes each choice; the agent that drives asks for the
next one where a choice's frontier has been seen, and where it was reached or cannot be. What could not be seen there is
dismissed.
"""

import math

import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.map_index import rig_of
from vssm_gym.agents.shared.strategy import Choice, ExplorationStrategy, Situation
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.frontier import frontier_cells
from vssm_gym.planning.floor_plan import FloorPlan

SHOWN_SHARE = 0.8  # fraction of a frontier's cells that are known, from which on it has been seen


class FrontierGoals:
    """Hold the present choice of an episode; see the module."""

    def __init__(self, strategy: ExplorationStrategy, margins: tuple[float, ...]) -> None:
        """Choose by ``strategy``, where the robot fits with the first of the margins (m) that leads anywhere."""
        self._strategy, self._margins = strategy, margins

    def reset(self, context: AgentContext, seed: int) -> None:
        """Open an episode."""
        self._strategy.reset(seed)
        self._radius, self._rig = 0.5 * context.body_length, rig_of(context)
        self._choice: Choice | None = None
        self._dismissed: list[np.ndarray] = []
        self.roadmap: Roadmap | None = None  # of the last choice, with the first margin

    def choose(self, m: VoxelMap, plan: FloorPlan, estimate: Localization) -> np.ndarray | None:
        """Return the next place ``(2,)``, m; None where nothing is left to see."""
        self._choice = None
        self.roadmap = None
        dismissed = np.concatenate(self._dismissed) if self._dismissed else np.empty((0, 2))
        T_body_cam = np.asarray(self._rig.T_body_cam, np.float64)
        for margin in self._margins:
            roadmap = Roadmap.of(plan, estimate.planar[:2], self._radius + margin)
            self.roadmap = roadmap if self.roadmap is None else self.roadmap
            situation = Situation(
                m, roadmap, estimate.planar, estimate.std, self._rig.camera, T_body_cam, dismissed, True
            )
            choice = self._strategy.choose(situation)
            if choice is not None and choice.goal is not None:
                self._choice = choice
                return np.asarray(choice.goal, np.float64)
        return None

    def leave(self) -> None:
        """Forget the choice: the robot has something better to do."""
        self._choice = None

    def is_seen(self, plan: FloorPlan) -> bool:
        """Return True where most of the chosen frontier is known."""
        target = None if self._choice is None else self._choice.target
        return target is not None and len(self._left(plan)) <= (1.0 - SHOWN_SHARE) * len(target)

    def heading(self, planar: np.ndarray) -> float | None:
        """Return the heading (rad) from ``planar`` towards the chosen frontier; None without one."""
        if self._choice is None or self._choice.target is None:
            return None
        dx, dy = self._choice.target.mean(axis=0) - planar[:2]
        return math.atan2(dy, dx)

    def dismiss(self, plan: FloorPlan, reached: bool) -> None:
        """End the choice: what is still unknown there cannot be seen, or the place cannot be reached."""
        choice, self._choice = self._choice, None
        if choice is None:
            return
        if not reached and choice.goal is not None:
            self._dismissed.append(np.asarray(choice.goal)[None])
        if choice.target is not None:
            self._dismissed.append(self._left(plan, choice) if reached else choice.target)

    def _left(self, plan: FloorPlan, choice: Choice | None = None) -> np.ndarray:
        """Return the cells of the frontier that are still frontiers, ``(n, 2)`` m."""
        choice = choice or self._choice
        assert choice is not None
        assert choice.target is not None
        cell = np.clip(plan.index(choice.target), 0, np.array(plan.cells.shape) - 1)
        return choice.target[frontier_cells(plan.cells)[cell[:, 0], cell[:, 1]]]
