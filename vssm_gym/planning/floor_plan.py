"""Read a floor plan from a growing belief: each column of cells is free, occupied or unknown to a body of some height.

    occupied: the mean occupancy exceeds 0 in an observed cell        free: none does, and half of the heights were seen

The plan is read from the map's own cells without interpolation, in milliseconds, so that it can follow the map from
step to step; :class:`~vssm_gym.planning.clearance.ClearanceMap` reads a finished map more finely. Two things that an
explorer knows besides its map are added. Where its body has been there is no obstacle. A thin leg that it saw nearby is
an obstacle, although the leg averages away in cells wider than itself.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.columns import OBSERVED_SHARE
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

CAMERA_REACH = 5.0  # m, up to which depth cameras measure well
PAD = CAMERA_REACH  # m of unknown space kept around what is known: as far as an explorer's camera sees


@dataclass(frozen=True)
class FloorPlan:
    """Hold the state of each column of the map for a body of some height.

    Attributes:
        cells: ``(nx, ny)`` int8 of ``FREE``, ``OCCUPIED``, ``UNKNOWN``, indexed along world x, y.
        occupancy: ``(nx, ny)`` float32 highest mean occupancy, m: positive in what is occupied.
        origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
    """

    cells: np.ndarray
    occupancy: np.ndarray
    origin: np.ndarray
    resolution: float

    @classmethod
    def of(
        cls,
        voxel_map: VoxelMap,
        z_min: float,
        z_max: float,
        body: np.ndarray | None = None,
        near: np.ndarray | None = None,
        seen: np.ndarray | None = None,
        blind: np.ndarray | None = None,
        keep: np.ndarray | None = None,
    ) -> "FloorPlan":
        """Read the plan of the heights ``z_min..z_max`` (m), cut to what is known with :data:`PAD` metres around it.

        Args:
            voxel_map: the belief; not kept, so that its memory may be given to the next update.
            z_min: above the floor's noise.
            z_max: top of the body.
            body: ``(cells x, cells y)`` bool over the whole map: where the robot's body has been: free.
            near: the same of a ring around it: free where it is unknown, because the camera looks over it.
            seen: the same: where something was seen at the body's height: occupied.
            blind: the same: where a camera that looked measured nothing: occupied where it is unknown.
            keep: ``(n, 2)`` places, m, that the plan holds as if they were known, as far as the map reaches.
        """
        origin, voxel = np.asarray(voxel_map.origin, np.float64), float(voxel_map.voxel_size)
        first, last = (int(np.clip(round((z - origin[2]) / voxel), 0, voxel_map.shape[2] - 1)) for z in (z_min, z_max))
        if voxel_map.table is None:
            slot = np.arange(int(np.prod(voxel_map.blocks)), dtype=np.int32).reshape(voxel_map.blocks)
            stored = np.ones(voxel_map.blocks, bool)
        else:
            slot = np.asarray(voxel_map.table.slot)
            stored = slot != 0
        occupancy, precision = np.asarray(voxel_map.occupancy), np.asarray(voxel_map.occupancy_precision)
        top, known = _columns(occupancy, precision, slot, stored, first, last)
        unknown = known < OBSERVED_SHARE * (last - first + 1)
        occupied = top > 0.0
        if near is not None:
            unknown &= ~near
        if blind is not None:
            blind = blind & unknown
            seen = blind if seen is None else seen | blind
        if seen is not None:
            occupied |= seen
            top = np.where(seen, np.maximum(top, 0.5 * voxel), top)
        if body is not None:
            unknown, occupied = unknown & ~body, occupied & ~body
            top = np.where(body, -voxel, top)
        cells = np.where(occupied, OCCUPIED, np.where(unknown, UNKNOWN, FREE)).astype(np.int8)
        held = cells != UNKNOWN
        if keep is not None:
            places = np.floor((keep - origin[:2]) / voxel + 0.5).astype(int)
            held[tuple(np.clip(places, 0, np.array(held.shape) - 1).T)] = True
        window = _around(held, round(PAD / voxel))
        start = np.array([window[0].start, window[1].start])
        cut_cells, cut_top = (np.ascontiguousarray(a[window]) for a in (cells, top.astype(np.float32)))
        return cls(cut_cells, cut_top, origin[:2] + start * voxel, voxel)

    def clearance(self, centre: np.ndarray | None = None, reach: float = 0.0) -> ClearanceMap:
        """Compute the signed distance to what is not free; with ``centre`` only within ``reach`` m of it.

        The map covers the known cells with one cell around them; beyond, a clearance map has no free space.
        """
        window = _around(self.cells != UNKNOWN, 1)
        if centre is not None:
            middle, size = self.index(centre), round(reach / self.resolution)
            near = [(max(0, c - size), min(n, c + size + 1)) for c, n in zip(middle, self.cells.shape, strict=True)]
            window = (slice(*near[0]), slice(*near[1]))
        cells, occupancy = self.cells[window], self.occupancy[window]
        # Half a cell is the unbiased place of a border without a surface, as in ClearanceMap.from_voxel_map.
        signed = np.where(cells == UNKNOWN, 0.5 * self.resolution, np.where(np.isfinite(occupancy), occupancy, -1.0))
        start = np.array([window[0].start, window[1].start])
        return ClearanceMap.from_occupancy(signed, self.origin + start * self.resolution, self.resolution)

    def index(self, xy: np.ndarray) -> np.ndarray:
        """Return the cells ``(..., 2)`` int of world points; they may lie outside."""
        return np.floor((np.asarray(xy, np.float64) - self.origin) / self.resolution + 0.5).astype(int)

    def centres(self, cells: np.ndarray) -> np.ndarray:
        """Return the centres ``(..., 2)`` of cells, world frame, m."""
        return self.origin + np.asarray(cells, np.float64) * self.resolution

    def state(self, xy: np.ndarray) -> np.ndarray:
        """Return ``FREE``, ``OCCUPIED`` or ``UNKNOWN`` at world points ``(..., 2)``; unknown beyond the plan."""
        cell = self.index(xy)
        inside = np.all((cell >= 0) & (cell < self.cells.shape), axis=-1)
        held = np.where(inside[..., None], cell, 0)
        return np.where(inside, self.cells[held[..., 0], held[..., 1]], UNKNOWN)


def changed_cells(before: FloorPlan, after: FloorPlan) -> np.ndarray:
    """Return the cells ``(n, 2)`` of ``after`` whose state differs; both plans were read from one map."""
    was = np.full(after.cells.shape, UNKNOWN, np.int8)
    i, j = np.rint((before.origin - after.origin) / after.resolution).astype(int)
    a, b = before.cells.shape
    inside = was[max(0, i) : max(0, i + a), max(0, j) : max(0, j + b)]
    x, y = max(0, -i), max(0, -j)  # of the part of `before` that lies in `after`
    inside[...] = before.cells[x : x + inside.shape[0], y : y + inside.shape[1]]
    return np.argwhere(was != after.cells)


def _around(known: np.ndarray, pad: int) -> tuple[slice, slice]:
    """Return the box around what is known with ``pad`` cells on each side; the whole grid where nothing is known."""
    spans = []
    for axis in (0, 1):
        index = np.flatnonzero(known.any(axis=1 - axis))
        n = known.shape[axis]
        spans.append(slice(max(0, index[0] - pad), min(n, index[-1] + pad + 1)) if len(index) else slice(0, n))
    return spans[0], spans[1]


@njit(cache=True, nogil=True)
def _columns(occupancy, precision, slot, stored, first, last):
    """Return the highest observed occupancy (-inf where none) and the number of observed cells per column.

    Both are over the heights ``first..last``.
    """
    bx, by, _ = slot.shape
    top = np.full((bx * BLOCK, by * BLOCK), -np.inf, np.float32)
    known = np.zeros((bx * BLOCK, by * BLOCK), np.int32)
    for a in range(bx):
        for b in range(by):
            for c in range(first // BLOCK, last // BLOCK + 1):
                if not stored[a, b, c]:
                    continue
                row = slot[a, b, c]
                k0, k1 = max(first - c * BLOCK, 0), min(last - c * BLOCK, BLOCK - 1)
                for i in range(BLOCK):
                    for j in range(BLOCK):
                        x, y = a * BLOCK + i, b * BLOCK + j
                        for k in range(k0, k1 + 1):
                            cell = (i * BLOCK + j) * BLOCK + k
                            if precision[row, cell] > OBSERVED_PRECISION:
                                known[x, y] += 1
                                top[x, y] = max(top[x, y], occupancy[row, cell])
    return top, known
