"""Cut a window, fixed in the world, out of a floor plan that grows: what is occupied, known and not yet seen in it."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_closing, binary_dilation

from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import footprint_cells
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN


@dataclass(frozen=True)
class PlanWindow:
    """Hold the newest floor plan on the cells of a square window.

    Attributes:
        corner: world position ``(2,)`` of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
        cells: ``(n, n)`` int8, FREE, OCCUPIED or UNKNOWN.
        occupancy: ``(n, n)`` as in the plan; ``-inf`` where it does not reach.
        unseen: ``(n, n)`` bool, the unknown cells that nothing seen encloses.
    """

    corner: np.ndarray
    resolution: float
    cells: np.ndarray
    occupancy: np.ndarray
    unseen: np.ndarray

    @classmethod
    def cut(cls, plan: FloorPlan, corner: np.ndarray, n: int) -> "PlanWindow":
        """Take the plan's cells and occupancy on ``n`` by ``n`` cells; unknown where the plan does not reach.

        An unknown cell that known ones enclose, or that lies between a free one and an obstacle, counts as seen. The
        others at the border of what is known do not: the first unknown cell behind a car may hold a wall.
        """
        cells, occupancy = np.full((n, n), UNKNOWN, np.int8), np.full((n, n), -np.inf, np.float32)
        first = np.round((plan.origin - corner) / plan.resolution).astype(int)
        ours = tuple(slice(max(0, f), min(n, f + m)) for f, m in zip(first, plan.cells.shape, strict=True))
        theirs = tuple(slice(s.start - f, s.stop - f) for s, f in zip(ours, first, strict=True))
        if all(s.stop > s.start for s in ours):
            cells[ours], occupancy[ours] = plan.cells[theirs], plan.occupancy[theirs]
        known, around = cells != UNKNOWN, np.ones((3, 3), bool)
        between = binary_dilation(cells == FREE, around) & binary_dilation(cells == OCCUPIED, around)
        return cls(corner, plan.resolution, cells, occupancy, ~(known | between | binary_closing(known, around)))

    @property
    def occupied(self) -> np.ndarray:
        """Return the occupied cells, ``(n, n)`` bool."""
        return self.cells == OCCUPIED

    def clearance(self, also: np.ndarray) -> ClearanceMap:
        """Return the distance to what is occupied, and to the cells of ``also`` ``(n, n)`` bool."""
        known = (self.cells != UNKNOWN) & np.isfinite(self.occupancy)
        field = np.where(known, self.occupancy, -self.resolution)
        field = np.where(also, np.maximum(field, 0.5 * self.resolution), field)
        return ClearanceMap.from_occupancy(field, self.corner, self.resolution)

    def under(self, planar: np.ndarray, car: Car, margin: float) -> np.ndarray:
        """Return the cells ``(k, 2)`` of the window under the footprint at a pose, ``margin`` (m) wider all around."""
        under = footprint_cells(self.corner, self.resolution, planar, car, margin)
        return under[np.all((under >= 0) & (under < self.cells.shape), axis=1)]

    def around(self, route: np.ndarray, car: Car, margin: float) -> np.ndarray:
        """Return the cells, ``(n, n)`` bool, within a margin (m) of the footprint along a route ``(m, 3)``."""
        near = np.zeros(self.cells.shape, bool)
        for pose in route:
            near[tuple(self.under(pose, car, margin).T)] = True
        return near
