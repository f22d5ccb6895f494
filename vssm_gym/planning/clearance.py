"""Compute the clearance: the signed Euclidean distance (m) from a point to the nearest place not free (eq. P1).

The map's field is a projective, truncated distance. It says where surfaces are and not how far they are. The clearance
is therefore a distance transform of its zero level on a fine 2D grid. It is positive in free space and negative inside
obstacles, so that a robot whose pose estimate overlaps a wall still knows which direction leads out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.maps.columns import BODY_HEIGHTS, OBSERVED_SHARE, level_distance, observed_columns
from vssm_gym.maps.voxel_map import VoxelMap

UNIFORM = np.empty((0, 0), np.float32)  # as a weight: 1 everywhere
OUTSIDE = -1.0  # m, clearance beyond the grid, where nothing is known; deep enough that no planner starts there
BORDER_ROUNDING = 1e-6  # cells; a border cell taken to world coordinates and back still lies on the grid


@dataclass(frozen=True)
class ClearanceMap:
    """Hold signed clearances on a uniform grid, bilinear between cell centres.

    Attributes:
        clearance: ``(nx, ny)`` float32, metres, indexed ``[ix, iy]`` along world x, y; C-contiguous.
        origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, metres.
        resolution: metres between cell centres.
        weight: ``(nx, ny)`` float32 >= 1, cost of a path a metre; None: 1 everywhere, the cost is the length.
    """

    clearance: np.ndarray
    origin: np.ndarray
    resolution: float
    weight: np.ndarray | None = None

    @classmethod
    def from_occupancy(cls, occupancy: np.ndarray, origin: np.ndarray, resolution: float) -> "ClearanceMap":
        """Compute the distance of every cell centre to the zero level of an occupancy.

        The level crosses the grid's lines where the linear interpolation of two neighbours does. The result is the
        distance to the nearest such crossing, which a transform of whole cells misses by up to half a cell. Values only
        place the surface between two neighbours: further away they need not be distances.

        Args:
            occupancy: ``(nx, ny)`` negative signed distance, m, positive inside obstacles.
            origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, m.
            resolution: m between cell centres.

        Returns:
            Clearances on the same grid, m.
        """
        clearance = level_distance(occupancy, resolution)
        return cls(np.ascontiguousarray(clearance), np.asarray(origin, dtype=np.float64), float(resolution))

    @classmethod
    def from_voxel_map(
        cls,
        voxel_map: VoxelMap,
        z_min: float = BODY_HEIGHTS[0],
        z_max: float = BODY_HEIGHTS[1],
        resolution: float = 0.025,
    ) -> "ClearanceMap":
        """Compute the clearance of a body that fills the heights ``z_min..z_max`` (m) of a learned map.

        A column is occupied where the mean field exceeds zero at any height. It is not free either where too few of its
        heights were ever observed. The grid covers the observed free columns with one cell around them.

        Args:
            voxel_map: the learned map; its z axis points up.
            z_min: lowest height of the body, m; above the noise of the floor.
            z_max: highest height of the body, m.
            resolution: m between cell centres.

        Returns:
            Clearances in the map's x and y, m.
        """
        low = voxel_map.bounds[0]
        top, share = observed_columns(voxel_map, z_min, z_max, resolution)
        unknown = share < OBSERVED_SHARE
        occupied = (top > 0.0) | unknown
        # An unobserved column has no surface to interpolate: half a cell is the unbiased place of its border.
        occupancy = np.where(unknown & (top <= 0.0), 0.5 * resolution, top)
        window = _window(~occupied)
        start = np.array([window[0].start, window[1].start])
        return cls.from_occupancy(occupancy[window], low[:2] + start * resolution, resolution)

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Interpolate the clearance bilinearly.

        Args:
            xy: world points ``(..., 2)``, m.

        Returns:
            ``(...)`` clearances, m; :data:`OUTSIDE` beyond the grid.
        """
        g = np.atleast_2d(self.to_grid(xy)).reshape(-1, 2)
        values = np.array([bilinear(self.clearance, x, y) for x, y in g])
        return values.reshape(np.shape(xy)[:-1])

    def to_grid(self, xy: np.ndarray) -> np.ndarray:
        """Convert world points to cell coordinates.

        Args:
            xy: world points ``(..., 2)``, m.

        Returns:
            ``(..., 2)`` continuous coordinates in cells; integers are cell centres.
        """
        return (np.asarray(xy, dtype=np.float64) - self.origin) / self.resolution

    def to_world(self, cells: np.ndarray) -> np.ndarray:
        """Convert cell coordinates to world points.

        Args:
            cells: continuous coordinates ``(..., 2)``, in cells.

        Returns:
            ``(..., 2)`` world points, m.
        """
        return np.asarray(cells, dtype=np.float64) * self.resolution + self.origin

    def with_obstacle(self, centre: np.ndarray, radius: float) -> "ClearanceMap":
        """``min(c(xy), |xy - centre| - radius)``: the same plan with one more disc, such as an obstacle that was hit.

        Args:
            centre: ``(2,)`` of the disc in the world, m.
            radius: of the disc, m.

        Returns:
            A map on the same grid.
        """
        x, y = (self.origin[a] + self.resolution * np.arange(self.clearance.shape[a]) for a in (0, 1))
        disc = np.hypot(x[:, None] - centre[0], y[None, :] - centre[1]) - radius
        clearance = np.minimum(self.clearance, disc).astype(np.float32, order="C")
        return replace(self, clearance=clearance)

    @property
    def weights(self) -> np.ndarray:
        """Return the weight as searches take it: :data:`UNIFORM` where there is none."""
        return UNIFORM if self.weight is None else self.weight


@dataclass(frozen=True)
class ClearanceField:
    """Describe clearance by a function ``xy (n, 2) -> clearance (n,)``, m, within a rectangle.

    A planner samples it once between the corners and plans on the samples. Beyond the rectangle nothing is free.

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
        """Return the field on a grid from ``low`` to at least ``high``, computed at the first use."""
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
"""The space that planners take: an array of clearances, or a function of the place."""


def on_grid(space: Space) -> ClearanceMap:
    """Return the space as an array; a function is sampled once, however often it is planned in."""
    return space.sampled if isinstance(space, ClearanceField) else space


def _window(free: np.ndarray) -> tuple[slice, slice]:
    """Return the smallest box around the free cells with one more cell on each side; all where none is free."""
    if not free.any():
        return slice(0, free.shape[0]), slice(0, free.shape[1])
    spans = []
    for axis in (0, 1):
        index = np.flatnonzero(free.any(axis=1 - axis))
        spans.append(slice(max(0, int(index[0]) - 1), min(free.shape[axis], int(index[-1]) + 2)))
    return spans[0], spans[1]


@njit(cache=True, nogil=True)
def bilinear(clearance: np.ndarray, x: float, y: float) -> float:
    """Return the clearance (m) at cell coordinates ``(x, y)``; :data:`OUTSIDE` beyond the outermost cell centres."""
    nx, ny = clearance.shape
    if not (-BORDER_ROUNDING <= x <= nx - 1 + BORDER_ROUNDING and -BORDER_ROUNDING <= y <= ny - 1 + BORDER_ROUNDING):
        return OUTSIDE
    i, j = min(int(x), nx - 2), min(int(y), ny - 2)
    a, b = x - i, y - j
    low = (1.0 - b) * clearance[i, j] + b * clearance[i, j + 1]
    high = (1.0 - b) * clearance[i + 1, j] + b * clearance[i + 1, j + 1]
    return (1.0 - a) * low + a * high
