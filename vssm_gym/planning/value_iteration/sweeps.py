"""Sweep ``W = gamma max_a share_a sum_c w_c W_c``: value iteration over (x, y, heading) (eq. P19).

``share_a`` is 1, or ``gamma^(k - 1)`` from poses where motion ``a`` counts ``k`` times
(:class:`~vssm_gym.planning.value_iteration.counts.Counts`).

With step cost 1 and ``V = 1 / (1 - gamma) - W`` the Bellman equation ``V = min_a 1 + gamma E[V']`` has no constant:
``W`` is the discounted reward of arriving, ``1 / (1 - gamma)`` at the goal, and exactly 0 in collision and wherever no
motion leads to the goal. From ``W = 0`` such states stay there, so a sealed room costs no sweeps, and the rounding of
large values does not stop the sweeps.

A motion moves all cells of a heading by the same displacement, so its successors are one window of the target heading's
plane, shifted by a fraction of a cell. Planes are stored flat with empty cells around them, in which windows may wrap
from one row into the next: the successors of a row are contiguous, which numba compiles to vector instructions. A row
whose successors did not change in the last sweep keeps its values: those that the goal has not reached yet, and those
that have converged.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from vssm_gym.planning.value_iteration.counts import Counts
from vssm_gym.planning.value_iteration.fused import fused
from vssm_gym.planning.value_iteration.motions import Motions

CHECK_EVERY = 4  # sweeps between two measurements of the residual
BAND_ROWS = 8  # rows of a plane that are computed together, if any of their successors changed


class Problem(NamedTuple):
    """Hold what the sweeps read of motions and map; planes are ``nx + 2 pad`` rows of ``ny + pad`` cells."""

    ends: Int[np.ndarray, "headings motions 3"]  # the target heading, and the lower corner in cells from the start
    weights: Float[np.ndarray, "headings motions 4"]  # of the corners (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1)
    allowed: Int[np.ndarray, "headings interior"]  # bit a: motion a from this cell is free
    priced: Bool[np.ndarray, "headings interior"] | None  # from where motions count several times; None: nowhere
    shares: Float[np.ndarray, "2"]  # of motions forwards, backwards from there


class Layout(NamedTuple):
    """Place cell ``[ix, iy]`` of a heading in its flat plane."""

    nx: int
    ny: int
    pad: int

    @property
    def row(self) -> int:
        """Return the number of cells between neighbours along x."""
        return self.ny + self.pad

    @property
    def interior(self) -> int:
        """Return the number of cells from the first one to the end of the last row."""
        return self.nx * self.row

    def flat(self, cells: np.ndarray) -> np.ndarray:
        """Reshape ``(headings, nx, ny)`` to ``(headings, interior)``; padding is zero."""
        return np.pad(cells, ((0, 0), (0, 0), (0, self.pad))).reshape(len(cells), self.interior)

    def cells(self, flat: np.ndarray) -> np.ndarray:
        """Invert :meth:`flat`."""
        return flat.reshape(len(flat), self.nx, self.row)[:, :, : self.ny]


def layout_of(motions: Motions, shape: tuple[int, ...], resolution: float) -> Layout:
    """Return the layout with padding for the longest motion and the corner behind it."""
    longest = np.floor(motions.length / resolution + 1e-9)  # rounded as corners_of rounds
    return Layout(shape[0], shape[1], int(longest) + 2)


def corners_of(motions: Motions, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of motions in cells from their starts: the lower corner and the bilinear weights of all four.

    Returns:
        int64 ``(headings, motions, 2)`` and float64 ``(headings, motions, 4)``, as in :class:`Problem`.
    """
    cells = motions.displacements / resolution
    # An arc along an axis must not read two columns because of a rounding error.
    cells = np.where(np.abs(cells - np.round(cells)) < 1e-9, np.round(cells), cells)
    low = np.floor(cells).astype(np.int64)
    u, v = np.moveaxis(cells - low, -1, 0)
    return low, np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], axis=-1)


def problem_of(
    motions: Motions,
    layout: Layout,
    resolution: float,
    blocked_motions: Bool[np.ndarray, "headings motions nx ny"],
    counts: Counts | None,
    gamma: float,
) -> Problem:
    """Prepare the sweeps from the arcs that collide, and how many motions one counts."""
    n = len(blocked_motions)
    low, weights = corners_of(motions, resolution)
    target = (np.arange(n)[:, None] + motions.heading_steps) % n
    allowed = np.zeros((n, layout.nx, layout.row), np.int32)
    _pack(blocked_motions, allowed)
    return Problem(
        np.concatenate([target[..., None], low], axis=-1),
        weights.astype(np.float32),
        allowed.reshape(n, layout.interior),
        None if counts is None else layout.flat(np.moveaxis(np.asarray(counts.poses), -1, 0)),
        np.ones(2, np.float32) if counts is None else np.float32(gamma) ** (np.asarray(counts.number) - np.float32(1)),
    )


@njit(cache=True, nogil=True)
def _pack(blocked_motions: np.ndarray, allowed: np.ndarray) -> None:
    """Set bit a of ``allowed`` ``(headings, nx, at least ny)`` int32 where motion a is free."""
    n, n_motions, nx, ny = blocked_motions.shape
    for h in range(n):
        for a in range(n_motions):
            bit = np.int32(1 << a)
            for x in range(nx):
                for y in range(ny):
                    allowed[h, x, y] |= np.int32(0) if blocked_motions[h, a, x, y] else bit


def iterate(
    problem: Problem,
    goal: Bool[np.ndarray, "headings interior"],
    start: Float[np.ndarray, "headings interior"],
    layout: Layout,
    gamma: float,
    top: float,
    tolerance: float,
    max_sweeps: int,
) -> tuple[Float[np.ndarray, "headings interior"], float, int]:
    """Sweep from ``start`` until ``max |W - gamma max_a E[W']| < tolerance`` or ``max_sweeps``, rounded up to fours.

    ``top = 1 / (1 - gamma)`` is ``W`` at the goal.

    Returns:
        ``W``, the largest change of the last sweep, which bounds the Bellman residual of ``W``, and the sweeps done.
    """
    margin = layout.pad * layout.row
    first = np.where(goal, np.float32(top), start.astype(np.float32))
    planes = np.pad(first, ((0, 0), (margin, margin)))
    sweeps, residual = _iterate(
        planes, goal, *problem, (*layout,), np.float32(gamma), np.float32(top), np.float32(tolerance), max_sweeps
    )
    return planes[:, margin : margin + layout.interior], float(residual), int(sweeps)


@njit(cache=True, nogil=True)
def _iterate(
    planes: np.ndarray,
    goal: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
    allowed: np.ndarray,
    priced: np.ndarray | None,
    shares: np.ndarray,
    layout: tuple[int, int, int],
    gamma: np.float32,
    top: np.float32,
    tolerance: np.float32,
    max_sweeps: int,
) -> tuple[int, np.float32]:
    """Sweep ``planes`` ``(headings, rows x cells)`` float32 in place; return the sweeps done and the largest change.

    The other arguments are the fields of :class:`Problem` and :class:`Layout`, and those of :func:`iterate`.
    """
    other = planes.copy()
    bands = len(planes), -(-layout[0] // BAND_ROWS)
    moved, moving = np.ones(bands, np.bool_), np.ones(bands, np.bool_)  # which changed: in the last sweep, in this one
    residual, sweeps = np.float32(np.inf), 0
    while residual >= tolerance and sweeps < max_sweeps:
        for k in range(CHECK_EVERY):
            measured = k == CHECK_EVERY - 1
            residual = _sweep(
                planes, other, moved, moving, goal, ends, weights, allowed, priced, shares, layout, gamma, top, measured
            )
            planes, other = other, planes
            moved, moving = moving, moved
        sweeps += CHECK_EVERY  # an even number: the newest values are in the caller's array again
    return sweeps, residual


@njit(cache=True, nogil=True)
def _sweep(
    before: np.ndarray,
    after: np.ndarray,
    moved: np.ndarray,
    moving: np.ndarray,
    goal: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
    allowed: np.ndarray,
    priced: np.ndarray | None,
    shares: np.ndarray,
    layout: tuple[int, int, int],
    gamma: np.float32,
    top: np.float32,
    measured: bool,
) -> np.float32:
    """Write ``after = gamma max_a share_a sum_c w_c before_c``; return the largest change, if it is ``measured``.

    ``moved`` and ``moving`` are ``(headings, bands)`` bool: which bands changed in the last sweep, and in this one.
    """
    nx, ny, pad = layout
    row, plane, n_motions = ny + pad, before.shape[1], ends.shape[1]
    stored = before.reshape(-1)
    best = np.empty(BAND_ROWS * row, np.float32)
    largest = np.float32(0.0)
    for h in range(len(before)):
        for band in range(moved.shape[1]):
            x = band * BAND_ROWS
            size = (min(x + BAND_ROWS, nx) - x) * row
            here, cells = (pad + x) * row, x * row
            old, new = before[h, here : here + size], after[h, here : here + size]
            new[:] = old
            moving[h, band] = False
            if not _successors_moved(moved, ends[h], x):
                continue
            best[:] = np.float32(0.0)
            bits = allowed[h, cells : cells + size]
            for a in range(n_motions):
                at, bit = ends[h, a, 0] * plane + here + ends[h, a, 1] * row + ends[h, a, 2], np.int32(1 << a)
                share = shares[2 * a // n_motions]
                w00, w01, w10, w11 = weights[h, a, 0], weights[h, a, 1], weights[h, a, 2], weights[h, a, 3]
                c00, c01 = stored[at : at + size], stored[at + 1 : at + 1 + size]
                c10, c11 = stored[at + row : at + row + size], stored[at + row + 1 : at + row + 1 + size]
                for k in range(size):
                    mean = fused(w11, c11[k], fused(w10, c10[k], fused(w01, c01[k], w00 * c00[k])))
                    if priced is not None:
                        mean = mean * share if priced[h, cells + k] else mean
                    mean = mean if bits[k] & bit else np.float32(0.0)
                    best[k] = mean if mean > best[k] else best[k]
            at_goal = goal[h, cells : cells + size]
            for k in range(size):
                new[k] = top if at_goal[k] else gamma * best[k]
            for k in range(size):
                moving[h, band] |= new[k] != old[k]
            if measured:
                for k in range(size):
                    largest = max(largest, abs(new[k] - old[k]))
    return largest


@njit(cache=True, nogil=True)
def _successors_moved(moved: np.ndarray, ends: np.ndarray, x: int) -> bool:
    """Return True where a band that holds successors of the rows from ``x`` on changed in the last sweep."""
    for target, low, _ in ends:
        for band in range((x + low) // BAND_ROWS, (x + BAND_ROWS + low) // BAND_ROWS + 1):
            if 0 <= band < moved.shape[1] and moved[target, band]:
                return True
    return False
