"""Test the car's footprint, an oriented rectangle, against the cells of a floor plan (eq. P8, P9).

    blocked(x, y, heading) = any occupied cell (a square) overlaps the rectangle of the pose, grown by a margin

The poses are cell centres, so which cells a heading's rectangle reaches is the same list of offsets everywhere and the
test of a whole plan is a dilation by them: exact, with no discs and no distance transform in between.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.maps.columns import BODY_HEIGHTS, OBSERVED_SHARE, observed_columns
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap

Unknown = Literal["optimistic", "mean", "averse"]

OVERLAP = 1e-9  # m; a smaller overlap is rounding, and contact is no collision
AVERSE_DEVIATIONS = 2.0  # of a surface's standard deviation: occupied from P(occupied) = 2.3 % on
ARENA_CELL = 0.035  # m, of a car's floor plan
CAR_HEIGHTS = (BODY_HEIGHTS[0], 0.2)  # m: above the floor's noise, up to just above the car's roof


@dataclass(frozen=True)
class Arena:
    """Hold the floor as planners of a car know it: its occupied cells and the distance to them.

    Attributes:
        occupied: ``(nx, ny)`` bool, indexed ``[ix, iy]`` along world x, y. Beyond the grid everything is occupied.
        clearance: signed distance to the same obstacles.
        origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
    """

    occupied: np.ndarray
    clearance: ClearanceMap
    origin: np.ndarray
    resolution: float

    @classmethod
    def from_occupied(cls, occupied: np.ndarray, origin: np.ndarray, resolution: float) -> "Arena":
        """Make an arena of whole cells: surfaces run halfway between an occupied and a free centre."""
        occupied, origin = np.asarray(occupied, dtype=bool), np.asarray(origin, dtype=np.float64)
        if occupied.ndim != 2 or min(occupied.shape) < 2:
            raise InputError("arena", "occupied", f"a grid of two cells a side or more; found shape {occupied.shape}")
        if not (np.isfinite(resolution) and resolution > 0.0):
            raise InputError("arena", "resolution", f"a positive cell size in metres; found {resolution!r}")
        occupancy = np.where(occupied, resolution, -resolution)
        return cls(occupied, ClearanceMap.from_occupancy(occupancy, origin, resolution), origin, float(resolution))


def arena_from_map(
    voxel_map: VoxelMap,
    unknown: Unknown = "mean",
    resolution: float = ARENA_CELL,
    z_min: float = CAR_HEIGHTS[0],
    z_max: float = CAR_HEIGHTS[1],
    bounds: np.ndarray | None = None,
) -> Arena:
    """Return the arena of a belief: cells in which a body of height ``z_min..z_max`` (m) would meet something.

    A cell is evaluated in columns half a voxel apart or less. With ``o ~ N(mean, std^2)`` the occupancy of a point, it
    is occupied where any observed point of any column has

    - ``"mean"``, ``"optimistic"``: ``mean > 0``, the most probable surface;
    - ``"averse"``: ``mean + 2 std > 0``, that is ``P(o > 0) > 2.3 %``: surfaces grow where few images saw them.

    ``std^2 = 0.03^2 / n m^2`` after ``n`` observations (:data:`~vssm_gym.maps.voxel_map.OBSERVATION_STD`). Where less
    than half of a cell's points were ever observed and nothing was met, the cell is unknown: free for ``"optimistic"``,
    else occupied.

    Args:
        voxel_map: The belief.
        unknown: One of the three.
        resolution: Edge of a cell, m.
        z_min: Lowest height of the body, above the noise of the floor.
        z_max: Its highest.
        bounds: ``(2, 2)`` lowest and highest x, y of the cell centres, m, so that plans of a growing map keep their
            grid; by default the box of what was observed and one cell around it. What lies outside the map is left
            out.

    Raises:
        InputError: an unknown treatment, no height, or a map that shows nothing at these heights and bounds.
    """
    if unknown not in get_args(Unknown):
        raise InputError("arena_from_map", "unknown", f"one of {', '.join(get_args(Unknown))}; found {unknown!r}")
    if not 0.0 < resolution <= 1.0:
        raise InputError("arena_from_map", "resolution", f"a cell size up to 1 m; found {resolution!r}")
    if not z_min < z_max:
        raise InputError("arena_from_map", "z_max", f"a height above z_min = {z_min} m; found {z_max}")
    per_cell = max(1, int(np.ceil(resolution / (0.5 * float(voxel_map.voxel_size)) - 1e-6)))
    spacing = resolution / per_cell
    deviations = AVERSE_DEVIATIONS if unknown == "averse" else 0.0
    top, share = observed_columns(voxel_map, z_min, z_max, spacing, deviations)
    nx, ny = (n // per_cell for n in top.shape)
    blocks = lambda a: a[: nx * per_cell, : ny * per_cell].reshape(nx, per_cell, ny, per_cell)
    met, seen = (blocks(top) > 0.0).any(axis=(1, 3)), blocks(share).mean(axis=(1, 3)) >= OBSERVED_SHARE
    occupied = met if unknown == "optimistic" else met | ~seen

    low = voxel_map.bounds[0, :2] + 0.5 * (per_cell - 1) * spacing  # the centre of cell [0, 0]
    observed = np.argwhere(met | seen)
    if len(observed) == 0:
        raise InputError(
            "arena_from_map", "voxel_map", f"something observed between {z_min} and {z_max} m; found nothing"
        )
    if bounds is None:
        first, last = observed.min(axis=0) - 1, observed.max(axis=0) + 1
    else:
        first, last = np.round((np.asarray(bounds, dtype=np.float64) - low) / resolution).astype(int)
    first, last = np.maximum(first, 0), np.minimum(last, (nx - 1, ny - 1))
    if np.any(last <= first):
        raise InputError("arena_from_map", "bounds", "a box of several cells that overlaps the map")

    fine = slice(first[0] * per_cell, (last[0] + 1) * per_cell), slice(first[1] * per_cell, (last[1] + 1) * per_cell)
    unseen = np.repeat(np.repeat(occupied & ~met, per_cell, 0), per_cell, 1)[fine]
    # An unobserved cell has no surface to interpolate: half a column is the unbiased place of its border.
    occupancy = np.where(unseen & (top[fine] <= 0.0), 0.5 * spacing, top[fine])
    corner = voxel_map.bounds[0, :2] + first * resolution
    window = occupied[first[0] : last[0] + 1, first[1] : last[1] + 1]
    clearance = ClearanceMap.from_occupancy(occupancy, corner, spacing)
    return Arena(np.ascontiguousarray(window), clearance, low + first * resolution, float(resolution))


def heading_grid(n: int) -> np.ndarray:
    """Return ``k 2 pi / n`` for ``k = 0 .. n - 1``, rad, float64."""
    return 2.0 * np.pi / n * np.arange(n)


def rectangle_collisions(
    occupied: np.ndarray, resolution: float, car: Car, headings: np.ndarray, margin: float = 0.0
) -> np.ndarray:
    """Mark where the car's rectangle, ``margin`` wider all around, overlaps an occupied cell or leaves the grid.

    Args:
        occupied: ``(nx, ny)`` bool, indexed along x, y.
        resolution: Edge of a cell, m.
        car: Its footprint about the rear axle.
        headings: ``(n_headings,)`` rad.
        margin: m, may be zero.

    Returns:
        ``(nx, ny, n_headings)`` bool for poses with the rear axle at cell centres. Exact: contact is no overlap.
    """
    kernels = _rectangles(car, float(resolution), tuple(np.asarray(headings, float).tolist()), float(margin))
    return np.ascontiguousarray(np.moveaxis(dilate(occupied, kernels), 0, -1))


@lru_cache(maxsize=16)  # depends on the car and the grid, not on the map
def _rectangles(car: Car, resolution: float, headings: tuple[float, ...], margin: float) -> "tuple[Kernel, ...]":
    """Return the cells under the car at each heading, in this order."""
    return tuple(Kernel.of(cells_under(np.array([[0.0, 0.0, h]]), resolution, car, margin)) for h in headings)


def collides(arena: Arena, planar: np.ndarray, car: Car, margin: float = 0.0) -> bool:
    """Test one pose ``(x, y, heading)`` (m, rad) as :func:`rectangle_collisions` does."""
    return overlaps(arena.occupied, arena.origin, arena.resolution, planar, car, margin)


def overlaps(
    cells: np.ndarray, origin: np.ndarray, resolution: float, planar: np.ndarray, car: Car, margin: float = 0.0
) -> bool:
    """Return True where the rectangle of one pose overlaps a cell that is set, or leaves the grid.

    Args:
        cells: ``(nx, ny)`` bool, indexed along x, y.
        origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
        planar: ``(x, y, heading)``, m and rad.
        car: its footprint about the rear axle.
        margin: by which the rectangle grows, m.
    """
    under = footprint_cells(origin, resolution, planar, car, margin)
    inside = np.all((under >= 0) & (under < cells.shape), axis=1)
    return bool(not inside.all() or cells[tuple(under.T)].any())


def footprint_cells(
    origin: np.ndarray, resolution: float, planar: np.ndarray, car: Car, margin: float = 0.0
) -> np.ndarray:
    """Return the cells ``(n, 2)`` int that the rectangle of one pose overlaps; they may lie outside the grid.

    Arguments as of :func:`overlaps`.
    """
    planar = np.asarray(planar, dtype=np.float64)
    cell = np.round((planar[:2] - origin) / resolution).astype(int)
    relative = np.array([[*(planar[:2] - origin - resolution * cell), planar[2]]])
    kernel = cells_under(relative, resolution, car, margin)
    return cell + np.argwhere(kernel) - len(kernel) // 2


def cells_under(planar: np.ndarray, resolution: float, car: Car, margin: float) -> np.ndarray:
    """Return the cells that any rectangle of ``(n, 3)`` poses overlaps, relative to a cell centred at the origin.

    By the separating axes of square and rectangle. Bool ``(2 k + 1, 2 k + 1)``, the cell at the origin in the middle.
    """
    half_length, half_width = 0.5 * car.length + margin, 0.5 * car.width + margin
    c, s = np.cos(planar[:, 2]), np.sin(planar[:, 2])
    x, y = planar[:, 0] + car.center_forward * c, planar[:, 1] + car.center_forward * s
    half = 0.5 * resolution
    reach = np.maximum(np.abs(x), np.abs(y)).max() + np.hypot(half_length, half_width) + half
    k = int(np.ceil(reach / resolution))
    cells = resolution * np.arange(-k, k + 1)
    c, s = c[:, None, None], s[:, None, None]
    dx, dy = cells[None, :, None] - x[:, None, None], cells[None, None, :] - y[:, None, None]
    # Coordinates of rows and columns overlap, and those along and across the car
    wide = (np.abs(dx) < half + np.abs(c) * half_length + np.abs(s) * half_width - OVERLAP) & (
        np.abs(dy) < half + np.abs(s) * half_length + np.abs(c) * half_width - OVERLAP
    )
    across = half * (np.abs(c) + np.abs(s))
    along = np.abs(c * dx + s * dy) < half_length + across - OVERLAP
    return (wide & along & (np.abs(c * dy - s * dx) < half_width + across - OVERLAP)).any(axis=0)


class Kernel(NamedTuple):
    """Hold the cells of a square around the origin as runs along the second axis."""

    reach: int  # cells from the origin to the border of the square
    runs: tuple[tuple[int, int, int], ...]  # (row, start, length), counted from the lowest corner of the square

    @classmethod
    def of(cls, cells: np.ndarray) -> "Kernel":
        """Take the runs of set cells of ``(2 k + 1, 2 k + 1)`` bool, the origin in the middle."""
        edges = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        (row, start), (_, end) = np.nonzero(edges == 1), np.nonzero(edges == -1)
        return cls(len(cells) // 2, tuple(zip(row.tolist(), start.tolist(), (end - start).tolist(), strict=True)))


def dilate(occupied: np.ndarray, kernels: Sequence[Kernel]) -> np.ndarray:
    """Dilate by each kernel ``K``: ``any_(i, j) in K occupied[x + i, y + j]``.

    A row of a kernel is a few runs of cells. Whether a run of length ``l`` that starts at a cell meets anything is
    worked out once for all kernels, so that a run costs one ``or`` over the grid however long it is.

    Args:
        occupied: ``(nx, ny)`` bool; beyond the grid everything is occupied.
        kernels: the sets ``K``.

    Returns:
        Bool ``(kernels, nx, ny)``.
    """
    nx, ny = occupied.shape
    reach = max(kernel.reach for kernel in kernels)
    padded = np.pad(np.asarray(occupied, dtype=bool), reach, constant_values=True)
    meets = [np.zeros_like(padded)]  # by length of the run
    for length in range(1, 1 + max((run[2] for kernel in kernels for run in kernel.runs), default=0)):
        longer = meets[-1].copy()
        longer[:, : padded.shape[1] - length + 1] |= padded[:, length - 1 :]
        meets.append(longer)

    blocked = np.zeros((len(kernels), nx, ny), dtype=bool)
    for kernel, out in zip(kernels, blocked, strict=True):
        shift = reach - kernel.reach
        for row, start, length in kernel.runs:
            x, y = row + shift, start + shift
            np.logical_or(out, meets[length][x : x + nx, y : y + ny], out=out)
    return blocked
