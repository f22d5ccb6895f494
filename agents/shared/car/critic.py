"""Compute the critic of the car's agents: value iteration to a target, with the widest margin that has a path."""

from dataclasses import replace

import numpy as np

from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import CostToGo, PoseGrid, ValueConfig, ValueResult, ValueStatus, solve

# Margin around the footprint (m) and fraction of the target's region, tried in turn. The first is the margin that the
# solvers of vi_mpc keep, and the middle of the region; then 1 cm, for the error of the map's surfaces; then none, and
# all of the region.
ATTEMPTS = ((0.03, 0.5), (0.01, 0.5), (0.0, 1.0))
NEARBY = 0.15  # m around a start that is occupied in the map, in which a pose with a path to the goal is searched


class Critic:
    """Compute costs-to-go in one floor plan; footprints are tested once for all targets."""

    def __init__(self, arena: Arena, car: Car) -> None:
        self._arena, self._car = arena, car
        self._grids: dict[float, PoseGrid] = {}

    def aim(self, planar: np.ndarray, goal: np.ndarray) -> ValueResult:
        """Return the cost-to-go of ``goal`` ``(2,)`` or ``(3,)``, or why the car at ``planar`` cannot get there."""
        for margin, fraction in ATTEMPTS:
            grid, region = self._grid(margin), (fraction * GOAL_RADIUS, fraction * GOAL_HEADING_TOLERANCE)
            result = solve(grid, goal, *region, start=planar)
            if result.cost_to_go is not None:
                return result
        if result.status is not ValueStatus.START_BLOCKED:
            return result
        result = solve(grid, goal, *region)  # blocked by the map, whose surfaces have errors: the car does stand there
        if result.cost_to_go is None or path_nearby(result.cost_to_go, planar):
            return result
        return replace(result, status=ValueStatus.UNREACHABLE, cost_to_go=None)

    def _grid(self, margin: float) -> PoseGrid:
        if margin not in self._grids:
            self._grids[margin] = PoseGrid.of(self._arena, self._car, ValueConfig(margin=margin))
        return self._grids[margin]


def path_nearby(value: CostToGo, planar: np.ndarray) -> bool:
    """Return True where a path to the goal begins within :data:`NEARBY` of a pose, at any heading."""
    cells = np.asarray(value.values).min(axis=-1)
    x, y = (value.origin[a] + value.resolution * np.arange(cells.shape[a]) for a in (0, 1))
    near = np.hypot(np.asarray(x)[:, None] - planar[0], np.asarray(y) - planar[1]) <= NEARBY
    return bool((cells[near] < np.float32(value.never)).any())
