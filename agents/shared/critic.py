"""The critic of the car's agents: value iteration to a target, with as much room around the car as there is."""

from dataclasses import replace

import numpy as np

from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import CostToGo, PoseGrid, ValueConfig, ValueResult, ValueStatus, solve

# Room around the footprint (m) and share of the target's region, tried in turn: to aim at the middle with room to
# spare, then as tightly as the car fits, then at all of the region.
ATTEMPTS = ((0.03, 0.5), (0.01, 0.5), (0.0, 1.0))
BESIDE = 0.15  # m around a start that the map calls occupied: how far it may err
REACHED, ALIGNED = 0.10, np.radians(15.0)  # m and rad from the target that count as there


class Critic:
    """Costs-to-go of one floor plan; the tests of footprints are made once for all targets."""

    def __init__(self, arena: Arena, car: Car) -> None:
        self._arena, self._car = arena, car
        self._grids: dict[float, PoseGrid] = {}

    def aim(self, planar: np.ndarray, goal: np.ndarray) -> ValueResult:
        """The cost-to-go of ``goal`` ``(2,)`` or ``(3,)``, or the reason why the car at ``planar`` cannot get there."""
        for margin, share in ATTEMPTS:
            grid, region = self._grid(margin), (share * REACHED, share * ALIGNED)
            result = solve(grid, goal, *region, start=planar)
            if result.cost_to_go is not None:
                return result
        if result.status is not ValueStatus.START_BLOCKED:
            return result
        result = solve(grid, goal, *region)  # blocked by the map, whose surfaces err: the car stands there after all
        if result.cost_to_go is None or _way_beside(result.cost_to_go, planar):
            return result
        return replace(result, status=ValueStatus.UNREACHABLE, cost_to_go=None)

    def _grid(self, margin: float) -> PoseGrid:
        if margin not in self._grids:
            self._grids[margin] = PoseGrid.of(self._arena, self._car, ValueConfig(margin=margin))
        return self._grids[margin]


def _way_beside(value: CostToGo, planar: np.ndarray) -> bool:
    """Whether a way to the goal begins within :data:`BESIDE` of a pose, at any heading."""
    cells = np.asarray(value.values).min(axis=-1)
    x, y = (value.origin[a] + value.resolution * np.arange(cells.shape[a]) for a in (0, 1))
    near = np.hypot(np.asarray(x)[:, None] - planar[0], np.asarray(y) - planar[1]) <= BESIDE
    return bool((cells[near] < np.float32(value.never)).any())
