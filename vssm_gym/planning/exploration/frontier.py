"""Frontiers: free cells beside unknown ones, in connected groups that the robot can get near to (Yamauchi 1997).

    frontier = {c free: some 4-neighbour of c is unknown}

What lies behind a frontier is worth the unknown area that becomes visible from a place, ``A(q)``: cells of the plan
that rays of length ``reach`` cross before they meet something occupied; unknown cells do not stop them.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

REACH = 5.0  # m: depth cameras are sharp so far
DISMISSED = 0.12  # m: a cell and its neighbours; a door of which half was seen is not given up with that half
RAYS = 240  # of a whole turn: two cells of 7 cm apart at the end of the reach


@dataclass(frozen=True)
class Frontier:
    """One connected group of frontier cells.

    Attributes:
        cells: ``(n, 2)`` int, in the plan that they were found in.
        xy: ``(n, 2)`` their centres, m.
        goal: ``(2,)`` the place nearest to the group's middle cell where the robot fits and that it can reach, m.
        distance: m of the way to there.
    """

    cells: np.ndarray
    xy: np.ndarray
    goal: np.ndarray
    distance: float


def frontier_cells(cells: np.ndarray) -> np.ndarray:
    """Which cells of a plan are free and have an unknown 4-neighbour; bool ``(nx, ny)``."""
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
    """The groups of frontier cells that the robot can get near to, nearest first.

    Args:
        plan: of the belief.
        distance: ``(nx, ny)`` m of the way from the robot to each cell of the plan, infinite where it does not fit.
        least: cells of a group; smaller ones are corners that rays just missed.
        near: a cell counts where the robot can come so near to it, m.
        length: groups wider than this (m) are cut in pieces, so that a goal stands for what is around it.
        dismissed: ``(n, 2)`` points, m: what is within :data:`DISMISSED` of one was looked at in vain.
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
        mask[tuple(cell[gap < DISMISSED].T)] = False
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
    """The cells of each label."""
    cell = np.argwhere(labels > 0)
    label = labels[tuple(cell.T)]
    order = np.argsort(label, kind="stable")
    return np.split(cell[order], np.searchsorted(label[order], np.arange(2, count + 1))) if count else []


def _pieces(group: np.ndarray, length: float) -> list[np.ndarray]:
    """A group cut across its main axis into pieces no longer than ``length`` cells."""
    centred = group - group.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0] if len(group) > 1 else np.array([1.0, 0.0])
    along = centred @ axis
    n = max(1, math.ceil((np.ptp(along) + 1.0) / length))
    part = np.minimum(((along - along.min()) / (np.ptp(along) + 1e-9) * n).astype(int), n - 1)
    return [group[part == k] for k in range(n) if (part == k).any()]


@njit(cache=True, nogil=True)
def visible_unknown(cells: np.ndarray, x: float, y: float, reach: float, hazard: np.ndarray, rays: int) -> np.ndarray:
    """Probability that each unknown cell is seen from ``(x, y)`` by a whole turn; float32 ``(nx, ny)``, 0 where known.

        p(c) = exp(-integral of hazard over the way of the ray through unknown cells before c)

    Rays end after ``reach`` or at an occupied cell. What is unknown may hide surfaces: they are met at the rate
    ``hazard``; with 0 unknown space hides none, which is what a map at its mean says.

    Args:
        cells: of a plan.
        x: of the place,
        y: both in cells.
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


def seen_unknown(plan: FloorPlan, xy: np.ndarray, hazard: float | np.ndarray = 0.0, reach: float = REACH) -> np.ndarray:
    """:func:`visible_unknown` of places ``(n, 2)`` (m): ``(n, cells)`` of those cells that any of them may see.

    ``hazard`` is per metre, the same everywhere or ``(nx, ny)``, and ``reach`` in metres; a row's sum times the area of
    a cell is ``A(q)``.
    """
    r = plan.resolution
    cells = (np.asarray(xy, np.float64) - plan.origin) / r
    met = np.ascontiguousarray(np.broadcast_to(np.float32(r) * np.asarray(hazard, np.float32), plan.cells.shape))
    seen = [visible_unknown(plan.cells, x, y, reach / r, met, RAYS).reshape(-1) for x, y in cells]
    every = np.stack(seen) if seen else np.zeros((0, plan.cells.size), np.float32)
    return every[:, every.any(axis=0)]
