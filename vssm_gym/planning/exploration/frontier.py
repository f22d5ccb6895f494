"""Find frontiers: connected groups of free cells beside unknown ones (Yamauchi 1997, eq. P39).

    frontier = {c free: some 4-neighbour of c is unknown}

The value of a place is the unknown area that becomes visible from it, ``A(q)`` (eq. P40): cells of the plan that rays
of length ``reach`` cross before they meet an occupied cell; unknown cells do not stop them.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from vssm_gym.planning.floor_plan import CAMERA_REACH, FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

# m: a cell of 7 cm and its neighbours, so that half a door is not dismissed with its other half
DISMISSED_FRONTIER = 0.12
RAYS = 240  # of a full turn: two cells of 7 cm apart at the end of the reach


@dataclass(frozen=True)
class Frontier:
    """Hold one connected group of frontier cells.

    Attributes:
        cells: ``(n, 2)`` int, in the plan that they were found in.
        xy: ``(n, 2)`` their centres, m.
        goal: ``(2,)`` the place nearest to the group's middle cell where the robot fits and that it can reach, m.
        distance: path length to the goal, m.
    """

    cells: np.ndarray
    xy: np.ndarray
    goal: np.ndarray
    distance: float


def frontier_cells(cells: np.ndarray) -> np.ndarray:
    """Mark the cells of a plan that are free and have an unknown 4-neighbour; bool ``(nx, ny)``."""
    unknown = cells == UNKNOWN
    beside = np.zeros(cells.shape, bool)
    beside[1:] |= unknown[:-1]
    beside[:-1] |= unknown[1:]
    beside[:, 1:] |= unknown[:, :-1]
    beside[:, :-1] |= unknown[:, 1:]
    return (cells == FREE) & beside


def frontiers(
    plan: FloorPlan,
    distance: np.ndarray,
    *,
    least: int = 3,
    near: float = 0.3,
    length: float = 1.5,
    dismissed: np.ndarray | None = None,
) -> list[Frontier]:
    """Find the groups of frontier cells that the robot can get near to, nearest first.

    Args:
        plan: of the belief.
        distance: ``(nx, ny)`` path length (m) from the robot to each cell of the plan, infinite where it does not fit.
        least: cells of a group; smaller ones are corners that rays just missed.
        near: a cell counts where the robot can come so near to it, m.
        length: groups wider than this (m) are cut in pieces, so that a goal stands for what is around it.
        dismissed: ``(n, 2)`` points, m; cells within :data:`DISMISSED_FRONTIER` of one are left out: they cannot be
            seen.
    """
    mask = frontier_cells(plan.cells)
    reached = np.isfinite(distance)
    if not (mask.any() and reached.any()):
        return []
    away, (at_x, at_y) = ndimage.distance_transform_edt(~reached, return_indices=True)
    mask &= away * plan.resolution <= near
    if dismissed is not None and len(dismissed):
        cell = np.argwhere(mask)
        gap = np.linalg.norm(plan.centres(cell)[:, None] - dismissed[None], axis=-1).min(axis=1)
        mask[tuple(cell[gap < DISMISSED_FRONTIER].T)] = False
    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    found = []
    for group in _groups(labels, count):
        if len(group) < least:
            continue
        for piece in _pieces(group, length / plan.resolution):
            middle = piece[np.argmin(np.linalg.norm(piece - piece.mean(axis=0), axis=1))]
            stand = np.array([at_x[tuple(middle)], at_y[tuple(middle)]])
            xy = plan.centres(piece)
            found.append(Frontier(piece, xy, plan.centres(stand), float(distance[tuple(stand)])))
    return sorted(found, key=lambda frontier: frontier.distance)


def _groups(labels: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the cells of each label."""
    cell = np.argwhere(labels > 0)
    label = labels[tuple(cell.T)]
    order = np.argsort(label, kind="stable")
    return np.split(cell[order], np.searchsorted(label[order], np.arange(2, count + 1))) if count else []


def _pieces(group: np.ndarray, length: float) -> list[np.ndarray]:
    """Cut a group across its main axis into pieces no longer than ``length`` cells."""
    centred = group - group.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0] if len(group) > 1 else np.array([1.0, 0.0])
    along = centred @ axis
    n = max(1, math.ceil((np.ptp(along) + 1.0) / length))
    part = np.minimum(((along - along.min()) / (np.ptp(along) + 1e-9) * n).astype(int), n - 1)
    return [group[part == k] for k in range(n) if (part == k).any()]


@njit(cache=True, nogil=True)
def visible_unknown(cells: np.ndarray, x: float, y: float, reach: float, hazard: np.ndarray, rays: int) -> np.ndarray:
    """Return the probability that a full turn at ``(x, y)`` sees each unknown cell; float32 ``(nx, ny)``, else 0.

        p(c) = exp(-integral of hazard along the ray through unknown cells before c)

    Rays end after ``reach`` or at an occupied cell. Unknown space may hide surfaces, which are met at the rate
    ``hazard``. With 0 it hides none, as in a map at its mean.

    Args:
        cells: of a plan.
        x: of the place, in cells.
        y: of the place, in cells.
        reach: in cells.
        hazard: per cell, ``(nx, ny)``.
        rays: of the turn.
    """
    nx, ny = cells.shape
    seen = np.zeros((nx, ny), np.float32)
    for r in range(rays):
        angle = 2.0 * math.pi * r / rays
        dx, dy = math.cos(angle), math.sin(angle)
        p = 1.0
        for k in range(1, int(2.0 * reach) + 1):
            i, j = math.floor(x + 0.5 * k * dx + 0.5), math.floor(y + 0.5 * k * dy + 0.5)
            if not (0 <= i < nx and 0 <= j < ny) or cells[i, j] == OCCUPIED:
                break
            if cells[i, j] == UNKNOWN:
                seen[i, j] = max(seen[i, j], p)
                p *= math.exp(-0.5 * hazard[i, j])
    return seen


def seen_unknown(
    plan: FloorPlan, xy: np.ndarray, hazard: float | np.ndarray = 0.0, reach: float = CAMERA_REACH
) -> np.ndarray:
    """Evaluate :func:`visible_unknown` at places ``(n, 2)`` (m): ``(n, cells)``, of the cells that any of them sees.

    ``hazard`` is per metre, the same everywhere or ``(nx, ny)``, and ``reach`` in metres; a row's sum times the area of
    a cell is ``A(q)``.
    """
    r = plan.resolution
    cells = (np.asarray(xy, np.float64) - plan.origin) / r
    met = np.ascontiguousarray(np.broadcast_to(np.float32(r) * np.asarray(hazard, np.float32), plan.cells.shape))
    seen = [visible_unknown(plan.cells, x, y, reach / r, met, RAYS).reshape(-1) for x, y in cells]
    every = np.stack(seen) if seen else np.zeros((0, plan.cells.size), np.float32)
    return every[:, every.any(axis=0)]
