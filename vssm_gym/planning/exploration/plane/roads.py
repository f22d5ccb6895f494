"""Find where a disc can drive in a planar map, how far everything is, and the way there (eq. P6).

occupied: the mean occupancy of an observed cell exceeds 0      free: it does not      unknown: never observed
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy import ndimage

from vssm_gym.geometry.grid_graph import LENGTHS, MOVES
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.grid_search.goal_distance import goal_distance
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

NEAR_START = 0.04  # m around the robot within which less room is enough, so that it can leave a tight place


@dataclass(frozen=True)
class PlaneRoads:
    """Hold the plan of a planar map and the path lengths from the robot.

    Attributes:
        plan: free, occupied and unknown cells.
        passable: ``(nx, ny)`` bool, free cells with enough room.
        headroom: ``(nx, ny)`` m from the nearest occupied cell's centre.
        distance: ``(nx, ny)`` m from the robot; infinite where no path leads.
    """

    plan: FloorPlan
    passable: np.ndarray
    headroom: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, m: PlanarMap, xy: Float[np.ndarray, "2"], room: float) -> "PlaneRoads":
        """Search from ``xy`` (m) through free cells farther than ``room`` (m) from occupied ones."""
        occupancy, cell = np.asarray(m.occupancy), float(m.cell_size)
        known = m.observed
        cells = np.where(known, np.where(occupancy > 0.0, OCCUPIED, FREE), UNKNOWN).astype(np.int8)
        plan = FloorPlan(cells, occupancy, np.asarray(m.origin, np.float64), cell)
        occupied = cells == OCCUPIED
        headroom = cell * ndimage.distance_transform_edt(~occupied) if occupied.any() else np.full(cells.shape, np.inf)
        passable = (cells == FREE) & (headroom >= room)
        low, high = plan.origin - xy, plan.origin - xy + cell * (np.array(cells.shape) - 1)
        x, y = (np.linspace(low[a], high[a], cells.shape[a]) for a in (0, 1))
        near = np.hypot(x[:, None], y[None]) <= NEAR_START
        here = headroom[tuple(np.clip(plan.index(xy[None])[0], 0, np.array(cells.shape) - 1))]
        passable |= near & (cells == FREE) & (headroom >= min(room, here - cell))
        gx, gy = (np.asarray(xy, np.float64) - plan.origin) / cell
        return cls(plan, passable, headroom, cell * goal_distance(passable, float(gx), float(gy)))

    def path_to(self, xy: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
        """Return the way from the robot to a place, by cells' centres, m; empty where none leads there.

        It goes back from the place down the steepest descent of the distance.
        """
        at = tuple(np.clip(self.plan.index(np.asarray(xy)[None])[0], 0, np.array(self.distance.shape) - 1).tolist())
        if not np.isfinite(self.distance[at]):
            return np.empty((0, 2))
        return self.plan.centres(_way_back(self.distance, *at)[::-1])

    def places(self, spacing: float) -> Float[np.ndarray, "n 2"]:
        """Return the reachable place with most room in each square of ``spacing`` (m), nearest first."""
        cell = np.argwhere(np.isfinite(self.distance) & (self.plan.cells == FREE))
        if not len(cell):
            return np.empty((0, 2))
        xy, room = self.plan.centres(cell), self.headroom[tuple(cell.T)]
        square = np.floor(xy / spacing).astype(int)
        square -= square.min(axis=0)
        key = square[:, 0] * (square[:, 1].max() + 1) + square[:, 1]
        order = np.lexsort((-room, key))
        best = order[np.unique(key[order], return_index=True)[1]]
        return xy[best[np.argsort(self.distance[tuple(cell[best].T)], kind="stable")]]

    def lengths_to(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the path lengths to places, m."""
        return self.distance[tuple(self.plan.index(xy).T)]


@njit(cache=True, nogil=True)
def _way_back(distance: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return the cells from ``(i, j)`` to where the distance is least, each the neighbour nearest to it by distance."""
    way = np.empty((distance.size, 2), np.int64)
    count = 0
    while True:
        way[count, 0], way[count, 1] = i, j
        count += 1
        best, to_i, to_j = np.inf, i, j
        for m in range(MOVES.shape[0]):
            a, b = i + MOVES[m, 0], j + MOVES[m, 1]
            if 0 <= a < distance.shape[0] and 0 <= b < distance.shape[1] and distance[a, b] < distance[i, j]:
                slope = (distance[a, b] - distance[i, j]) / LENGTHS[m]
                if slope < best:
                    best, to_i, to_j = slope, a, b
        if (to_i == i and to_j == j) or count == distance.size:
            return way[:count]
        i, j = to_i, to_j
