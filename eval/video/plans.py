"""Cut the floor plan of a belief to what is known, for pictures of it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int8

from vssm_gym.agents.shared.own_map import OwnMapConfig
from vssm_gym.eval.report.explore_figures import KNOWN_MARGIN
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import UNKNOWN


@dataclass(frozen=True)
class CroppedPlan:
    """Hold the known part of a floor plan.

    Attributes:
        cells: ``(nx, ny)`` of FREE, OCCUPIED and UNKNOWN (:mod:`vssm_gym.planning.occupancy_grid`).
        origin: world position of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
    """

    cells: Int8[np.ndarray, "nx ny"]
    origin: Float[np.ndarray, "2"]
    resolution: float

    @classmethod
    def of(cls, m: VoxelMap) -> "CroppedPlan":
        """Compute the plan of a belief at the heights of the robot's body."""
        return cls.cut(FloorPlan.of(m, *OwnMapConfig().heights))

    @classmethod
    def cut(cls, plan: FloorPlan) -> "CroppedPlan":
        """Copy the known part of a plan; one unknown cell where nothing is known."""
        known = plan.cells != UNKNOWN
        if not known.any():
            return cls(plan.cells[:1, :1].copy(), plan.origin, plan.resolution)
        rows, columns = (np.flatnonzero(known.any(axis=a)) for a in (1, 0))
        low, end = np.array([rows[0], columns[0]]), np.array([rows[-1], columns[-1]]) + 1
        return cls(plan.cells[low[0] : end[0], low[1] : end[1]].copy(), plan.centres(low), plan.resolution)

    @property
    def bounds(self) -> Float[np.ndarray, "2 2"]:
        """Return the lowest and the highest corner, ``(2, 2)``, m."""
        low = self.origin - 0.5 * self.resolution
        return np.stack([low, low + self.resolution * np.array(self.cells.shape)])

    def around(self, centre: Float[np.ndarray, "2"], reach: float, n: int) -> Int8[np.ndarray, "n n"]:
        """Return the states at ``n`` x ``n`` points of the square ``centre`` +- ``reach`` (m); UNKNOWN beyond."""
        along = reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
        index = [np.floor((centre[a] + along - self.origin[a]) / self.resolution + 0.5).astype(int) for a in (0, 1)]
        inside = [(index[a] >= 0) & (index[a] < self.cells.shape[a]) for a in (0, 1)]
        cells = self.cells[np.ix_(*(np.where(held, at, 0) for at, held in zip(index, inside, strict=True)))]
        return np.where(inside[0][:, None] & inside[1][None, :], cells, np.int8(UNKNOWN))


def bounds_of(boxes: Iterable[Float[np.ndarray, "2 2"]]) -> Float[np.ndarray, "2 2"]:
    """Return the lowest and highest corner of boxes (m), with ``KNOWN_MARGIN`` m on each side."""
    corners = np.array(list(boxes))
    return np.stack([corners[:, 0].min(axis=0) - KNOWN_MARGIN, corners[:, 1].max(axis=0) + KNOWN_MARGIN])
