"""Measure how much of an apartment a camera has seen: the area of the plan that its rays have crossed.

    coverage = |seen cells| / |cells that are seen from any reachable position in any direction|

The plan is cut into cells of ``COVERAGE_CELL``. A cell is seen when a ray at the camera's height, of its horizontal
field of view and no longer than ``SEEING_RANGE``, crosses it before it hits anything. The denominator is the reachable,
observable area: it excludes what is walled off, behind furniture, or beyond the plan, so that 1 can be attained and
90 % means 90 % of what there is to see. It is computed once for an apartment, from all positions of a grid in free
space.
"""

import math

import numba
import numpy as np
import shapely
from jaxtyping import Bool, Float

from vssm_gym.envs.physics.tracing import Tracer
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.geometry.axes import PlanarPose

COVERAGE_CELL = 0.1  # m
SEEING_RANGE = 5.0  # m, how far seeing counts: depth cameras are sharp so far
POSITION_SPACING = 0.2  # m between the positions that decide what is observable
_RAYS_OF_A_TURN = 360  # rays of a whole turn there


class Observable:
    """Hold the grid of an apartment's plan and the cells that can be seen at all; see the module.

    Args:
        space: the free space, whose largest connected part counts.
        tracer: the scene's ray tracer.
        height: height of the camera above the floor, m.
    """

    def __init__(self, space: FreeSpace, tracer: Tracer, height: float) -> None:
        self._tracer, self._height = tracer, height
        low, high = np.split(np.array(space.largest.bounds), 2)
        self.origin: Float[np.ndarray, 2] = low - SEEING_RANGE
        shape = np.ceil((high - low + 2.0 * SEEING_RANGE) / COVERAGE_CELL).astype(int)
        self.cells: Bool[np.ndarray, "nx ny"] = np.zeros(tuple(shape), dtype=bool)
        xs, ys = (np.arange(a, b, POSITION_SPACING) for a, b in zip(low, high, strict=True))
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = grid[shapely.contains_xy(space.largest, grid)]
        around = np.linspace(-math.pi, math.pi, _RAYS_OF_A_TURN, endpoint=False)
        for position in inside if len(inside) else [np.array(space.largest.representative_point().coords[0])]:
            self.mark(position, around, self.cells)

    @property
    def area(self) -> float:
        """Return the area that can be seen, m^2."""
        return float(self.cells.sum()) * COVERAGE_CELL**2

    def mark(
        self, xy: Float[np.ndarray, "2"], bearings: Float[np.ndarray, "n"], cells: Bool[np.ndarray, "nx ny"]
    ) -> int:
        """Set the cells that rays from ``xy`` in world directions ``bearings`` cross; return how many were not set."""
        directions = np.stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)], axis=1)
        origin = np.array([xy[0], xy[1], self._height])
        distance, _ = self._tracer.trace(origin, np.ascontiguousarray(directions, dtype=np.float32))
        reach = np.where(distance > 0.0, np.minimum(distance, SEEING_RANGE), SEEING_RANGE)
        return _mark(
            (np.asarray(xy, dtype=np.float64) - self.origin) / COVERAGE_CELL,
            directions[:, :2],
            reach / COVERAGE_CELL,
            cells,
        )


class Coverage:
    """Accumulate the cells that one camera has seen.

    Args:
        observable: the apartment's observable cells; shared.
        hfov: the camera's horizontal field of view, rad.
    """

    def __init__(self, observable: Observable, hfov: float) -> None:
        self._observable = observable
        # Neighbouring rays part by less than half a cell at the end of their reach.
        rays = math.ceil(hfov * SEEING_RANGE / (0.5 * COVERAGE_CELL))
        self._bearings = np.linspace(-0.5 * hfov, 0.5 * hfov, rays)
        self.seen = np.zeros_like(observable.cells)

    def reset(self) -> None:
        """Clear the seen cells."""
        self.seen[:] = False

    def see(self, planar: PlanarPose) -> float:
        """Add the view from ``(x, y, heading)``; return the increase of the coverage."""
        before = self.fraction
        self._observable.mark(planar[:2], planar[2] + self._bearings, self.seen)
        self.seen &= self._observable.cells
        return self.fraction - before

    @property
    def fraction(self) -> float:
        """Return the coverage, in [0, 1]."""
        return float(self.seen.sum()) / float(self._observable.cells.sum())


@numba.njit(nogil=True, cache=True)
def _mark(start, directions, reach, cells):
    """Set the cells along rays, sampled twice a cell, in units of cells; what leaves the grid is cut off."""
    new = 0
    for k in range(directions.shape[0]):
        for i in range(int(2.0 * reach[k])):
            x = math.floor(start[0] + 0.5 * i * directions[k, 0])
            y = math.floor(start[1] + 0.5 * i * directions[k, 1])
            if 0 <= x < cells.shape[0] and 0 <= y < cells.shape[1] and not cells[x, y]:
                cells[x, y] = True
                new += 1
    return new
