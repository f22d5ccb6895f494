"""Sum ``1/2 log(1 + n lambda_u / lambda)`` over the cells of trajectories through views, compiled (eq. P34).

A view of a cell seen ``n`` times before adds ``1/2 log(1 + lambda_u / (lambda + n lambda_u))``; over a trajectory these
terms telescope. Trajectories are taken in an order in which those with a common beginning follow each other. What the
next one does not share is taken back, so that a tree of trajectories costs as many steps as it has nodes.
"""

from collections.abc import Sequence

import numpy as np
from numba import njit

from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.information.observed import ROWS, Observed, heights


def gains(
    m: VoxelMap, seen: Sequence[Observed], paths: np.ndarray, weight: float, every: int, known: float
) -> np.ndarray:
    """Return the nats of steps 0 to k together, for all k of all trajectories.

    Args:
        m: map belief: the precisions ``lambda``.
        seen: cells of each view.
        paths: ``(candidates, steps)`` int64 indices of views; -1: no step.
        weight: ``lambda_u``, the precision of one observation.
        every: of the cells, as for ``seen``: each one counted stands for so many.
        known: precision above which a cell adds nothing.

    Returns:
        ``(candidates, steps)`` float64.
    """
    along = np.empty(paths.shape)
    order = np.lexsort(paths.T[::-1])
    start, place, words, precision = _listed(m, seen, every)
    _count(paths, order, start, place, words, np.where(precision > known, np.inf, precision), weight, along)
    return every * along


def _listed(m: VoxelMap, seen: Sequence[Observed], every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """List all views' cells, with a place and a precision for every cell of the blocks that any view sees.

    Returns:
        Where each view's entries start ``(views + 1,)``; the entries' place among the blocks seen; their bit sets; and
        the precisions ``(blocks seen, 8 / every, 64)`` of the cells that the bits stand for.
    """
    start = np.cumsum([0, *(len(view.block) for view in seen)])
    blocks, place = np.unique(np.concatenate([view.block for view in seen]), return_inverse=True)
    slot = blocks if m.table is None else np.asarray(m.table.slot).reshape(-1)[blocks]
    cells = np.arange(ROWS) * BLOCK + heights(every)
    precision = np.asarray(m.occupancy_precision)[slot[:, None, None], cells]
    return start, place, np.concatenate([view.words for view in seen]), precision


@njit(cache=True, nogil=True)
def _add(view, start, place, words, precision, weight, counts):
    """Count one more image of a view's cells; return the nats that it adds."""
    nats, product = 0.0, 1.0
    for entry in range(start[view], start[view + 1]):
        b = place[entry]
        for s in range(words.shape[1]):
            word = words[entry, s]
            for r in range(ROWS):
                if (word >> np.uint64(r)) & np.uint64(1):
                    now = precision[b, s, r] + counts[b, s, r] * weight
                    product *= 1.0 + weight / now
                    counts[b, s, r] += 1
                    if product > 1e100:  # one logarithm for many cells
                        nats += np.log(product)
                        product = 1.0
    return 0.5 * (nats + np.log(product))


@njit(cache=True, nogil=True)
def _remove(view, start, place, words, counts):
    """Subtract one image of a view's cells."""
    for entry in range(start[view], start[view + 1]):
        b = place[entry]
        for s in range(words.shape[1]):
            word = words[entry, s]
            for r in range(ROWS):
                counts[b, s, r] -= (word >> np.uint64(r)) & np.uint64(1)


@njit(cache=True, nogil=True)
def _count(paths, order, start, place, words, precision, weight, along):
    """Fill ``along``, trajectory by trajectory; each keeps the counts of the beginning that it shares with the last."""
    counts = np.zeros(precision.shape, np.uint16)
    steps = paths.shape[1]
    last = order[0]
    for turn in range(len(order)):
        c = order[turn]
        shared = 0
        if turn > 0:
            while shared < steps and paths[c, shared] == paths[last, shared]:
                along[c, shared] = along[last, shared]
                shared += 1
            for step in range(shared, steps):
                if paths[last, step] >= 0:
                    _remove(paths[last, step], start, place, words, counts)
        for step in range(shared, steps):
            gained = along[c, step - 1] if step > 0 else 0.0
            if paths[c, step] >= 0:
                gained += _add(paths[c, step], start, place, words, precision, weight, counts)
            along[c, step] = gained
        last = c
