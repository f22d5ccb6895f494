"""Clearance: ``c(xy) = `` signed Euclidean distance (m) from a point of the floor plan to the nearest place not free.

The map's field is a projective, truncated distance, so it says where surfaces are and not how far they are:
the clearance is a distance transform of its zero level on a fine 2D grid. It is positive in free space and
negative inside obstacles, so that a robot whose estimate touches a wall still sees which way leads out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.maps.columns import OBSERVED_SHARE, level_distance, observed_columns
from vssm_gym.maps.voxel_map import VoxelMap

OUTSIDE = -1.0  # m, clearance beyond the grid: nothing is known there
ROUNDING = 1e-6  # cells: the world coordinates of a border cell, taken back to the grid, still lie on it


@dataclass(frozen=True)
class ClearanceMap:
    """Signed clearance on a uniform grid, bilinear between cell centres.

    Attributes:
        clearance: ``(nx, ny)`` float32, metres, indexed ``[ix, iy]`` along world x, y; C-contiguous.
        origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, metres.
        resolution: metres between cell centres.
    """

    clearance: np.ndarray
    origin: np.ndarray
    resolution: float

    @classmethod
    def from_depth(cls, depth: np.ndarray, origin: np.ndarray, resolution: float) -> "ClearanceMap":
        """Distance of every cell centre to the zero level of ``depth`` (m, positive inside obstacles, ``(nx, ny)``).

        The level crosses the grid's lines where the linear interpolation of two neighbours does; the distance to the
        nearest such crossing is what a transform of whole cells misses by up to half a cell. Depths only place the
        surface between two neighbours: they need not be distances further away.
        """
        clearance = level_distance(depth, resolution)
        return cls(np.ascontiguousarray(clearance), np.asarray(origin, dtype=np.float64), float(resolution))

    @classmethod
    def from_voxel_map(
        cls, voxel_map: VoxelMap, z_min: float = 0.08, z_max: float = 0.5, resolution: float = 0.025
    ) -> "ClearanceMap":
        """Clearance of a body that fills ``z_min..z_max`` (m) of a learned map; ``z_min`` lies above the floor's noise.

        A column is occupied where the mean field exceeds zero at any height, and not free either where too few of its
        heights were ever observed. The grid covers the observed free columns with one cell around them.
        """
        low = voxel_map.bounds[0]
        top, share = observed_columns(voxel_map, z_min, z_max, resolution)
        unknown = share < OBSERVED_SHARE
        occupied = (top > 0.0) | unknown
        # An unobserved column has no surface to interpolate: half a cell is the unbiased place of its border.
        depth = np.where(unknown & (top <= 0.0), 0.5 * resolution, top)
        window = _window(~occupied)
        start = np.array([window[0].start, window[1].start])
        return cls.from_depth(depth[window], low[:2] + start * resolution, resolution)

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Clearance (m) at world points ``(..., 2)``; :data:`OUTSIDE` beyond the grid."""
        g = np.atleast_2d(self.to_grid(xy)).reshape(-1, 2)
        values = np.array([bilinear(self.clearance, x, y) for x, y in g])
        return values.reshape(np.shape(xy)[:-1])

    def to_grid(self, xy: np.ndarray) -> np.ndarray:
        """Continuous cell coordinates ``(..., 2)`` of world points; integers are cell centres."""
        return (np.asarray(xy, dtype=np.float64) - self.origin) / self.resolution

    def to_world(self, cells: np.ndarray) -> np.ndarray:
        """World points ``(..., 2)`` of continuous cell coordinates."""
        return np.asarray(cells, dtype=np.float64) * self.resolution + self.origin

    def with_obstacle(self, centre: np.ndarray, radius: float) -> "ClearanceMap":
        """``min(c(xy), |xy - centre| - radius)``: the same plan with one more disc that was felt but never seen."""
        x, y = (self.origin[a] + self.resolution * np.arange(self.clearance.shape[a]) for a in (0, 1))
        disc = np.hypot(x[:, None] - centre[0], y[None, :] - centre[1]) - radius
        return ClearanceMap(
            np.minimum(self.clearance, disc).astype(np.float32, order="C"), self.origin, self.resolution
        )


@dataclass(frozen=True)
class ClearanceField:
    """Clearance as a function of the place, for planners: ``xy (n, 2) -> clearance (n,)``, m, within a rectangle.

    A planner samples it once, between the corners, and plans on the samples; beyond the rectangle nothing is free.

    Attributes:
        at: ``(n, 2)`` world points to ``(n,)`` signed clearances, m; it may change by no more than the distance moved.
        low: ``(2,)`` world position of the lowest corner, m.
        high: ``(2,)`` of the highest, m.
        resolution: m between samples.
    """

    at: Callable[[np.ndarray], np.ndarray]
    low: np.ndarray
    high: np.ndarray
    resolution: float

    def __post_init__(self) -> None:
        low, high = np.asarray(self.low, np.float64), np.asarray(self.high, np.float64)
        if not (low.shape == high.shape == (2,) and np.isfinite([low, high]).all() and (low < high).all()):
            raise InputError("ClearanceField", "low, high", f"two finite corners, low < high; found {low!r}, {high!r}")
        if not (math.isfinite(self.resolution) and self.resolution > 0.0):
            raise InputError("ClearanceField", "resolution", f"a positive length in metres; found {self.resolution!r}")

    @cached_property
    def sampled(self) -> ClearanceMap:
        """The field on a grid from ``low`` to at least ``high``, made at the first use."""
        low, extent = np.asarray(self.low, np.float64), np.subtract(self.high, self.low)
        nx, ny = (math.ceil(e / self.resolution - 1e-9) + 1 for e in extent)
        cells = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1).reshape(-1, 2)
        values = np.asarray(self.at(low + cells * self.resolution))
        if values.shape != (nx * ny,) or not np.isfinite(values).all():
            expected = f"{nx * ny} finite clearances for as many points; found shape {values.shape}"
            raise InputError("ClearanceField", "at", expected)
        clearance = np.ascontiguousarray(values.reshape(nx, ny), np.float32)
        return ClearanceMap(clearance, low, float(self.resolution))


Space: TypeAlias = ClearanceMap | ClearanceField
"""Where a disc's centre has how much room, as planners take it: an array of clearances, or a function."""


def on_grid(space: Space) -> ClearanceMap:
    """Return the space as an array; a function is sampled once, however often it is planned in."""
    return space.sampled if isinstance(space, ClearanceField) else space


def _window(free: np.ndarray) -> tuple[slice, slice]:
    """The smallest box around the free cells with one more cell on each side; the whole grid where none is free."""
    if not free.any():
        return slice(0, free.shape[0]), slice(0, free.shape[1])
    spans = []
    for axis in (0, 1):
        index = np.flatnonzero(free.any(axis=1 - axis))
        spans.append(slice(max(0, int(index[0]) - 1), min(free.shape[axis], int(index[-1]) + 2)))
    return spans[0], spans[1]


@njit(cache=True, nogil=True)
def bilinear(clearance: np.ndarray, x: float, y: float) -> float:
    """Clearance (m) at cell coordinates ``(x, y)``; :data:`OUTSIDE` beyond the outermost cell centres."""
    nx, ny = clearance.shape
    if not (-ROUNDING <= x <= nx - 1 + ROUNDING and -ROUNDING <= y <= ny - 1 + ROUNDING):
        return OUTSIDE
    i, j = min(int(x), nx - 2), min(int(y), ny - 2)
    a, b = x - i, y - j
    low = (1.0 - b) * clearance[i, j] + b * clearance[i, j + 1]
    high = (1.0 - b) * clearance[i + 1, j] + b * clearance[i + 1, j + 1]
    return (1.0 - a) * low + a * high
