"""Solve for the cost-to-go over (x, y, heading) of the car by value iteration: the critic of its controllers."""

from vssm_gym.planning.value_iteration.cost_to_go import CostToGo
from vssm_gym.planning.value_iteration.counts import Counts
from vssm_gym.planning.value_iteration.motions import Motions
from vssm_gym.planning.value_iteration.solver import (
    PoseGrid,
    ValueConfig,
    ValueResult,
    ValueStatus,
    solve,
    solve_region,
)

__all__ = [
    "CostToGo",
    "Counts",
    "Motions",
    "PoseGrid",
    "ValueConfig",
    "ValueResult",
    "ValueStatus",
    "solve",
    "solve_region",
]
