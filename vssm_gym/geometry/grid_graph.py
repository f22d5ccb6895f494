"""Build the 16-neighbour graph of a uniform 2D grid: straight, diagonal and knight's moves, edge cost = length.

A path along its edges is at most 2.75 % longer than the straight line that it approximates (1 / cos of half of the
largest angle between two moves, 26.6 degrees). The caller decides which edges are free: planners by the cells that an
interpolated clearance reads, the simulator by exact polygons, the imagined environments by samples.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.sparse import csr_array

# Each row: di, dj. Searches that break ties by the order of the moves rely on this one.
MOVES = np.array(
    [
        *([1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]),
        *([2, 1], [1, 2], [-1, 2], [-2, 1], [-2, -1], [-1, -2], [1, -2], [2, -1]),
    ]
)
LENGTHS = np.hypot(MOVES[:, 0], MOVES[:, 1])  # cells
LONGEST = float(LENGTHS.max())  # cells

# One of each pair of opposite moves: enough for the edges of an undirected graph.
_ONE_WAY = MOVES[(MOVES[:, 0] > 0) | ((MOVES[:, 0] == 0) & (MOVES[:, 1] > 0))]


@njit(cache=True, nogil=True)
def edge_free(free: np.ndarray, i: int, j: int, di: int, dj: int) -> bool:
    """Return True if every cell that a bilinear interpolation along the move reads is free.

    The interpolated value is a convex combination of those cells, so the whole segment is free then. The start cell
    ``(i, j)`` is not tested.
    """
    nx, ny = free.shape
    if not (0 <= i + di < nx and 0 <= j + dj < ny) or not free[i + di, j + dj]:
        return False
    if di == 0 or dj == 0:
        return True
    si, sj = (1 if di > 0 else -1), (1 if dj > 0 else -1)
    if not (free[i + si, j] and free[i, j + sj]):
        return False
    if abs(di) == 2:
        return free[i + si, j + sj] == 1 and free[i + di, j] == 1
    if abs(dj) == 2:
        return free[i + si, j + sj] == 1 and free[i, j + dj] == 1
    return True


def edges(free: Bool[np.ndarray, "nx ny"]) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """List the edges between free nodes, each once: flat indices of both ends and the length in cells.

    Only the two ends are tested; the caller tests what lies between them.
    """
    nx, ny = free.shape
    index = np.arange(free.size).reshape(free.shape)
    begin, end, length = [], [], []
    for di, dj in _ONE_WAY:
        a = (slice(0, max(0, nx - di)), slice(max(0, -dj), max(0, ny - max(0, dj))))
        b = (slice(di, nx), slice(max(0, dj), max(0, ny + min(0, dj))))
        both = free[a] & free[b]
        begin.append(index[a][both])
        end.append(index[b][both])
        length.append(np.full(both.sum(), np.hypot(di, dj)))
    return np.concatenate(begin), np.concatenate(end), np.concatenate(length)


def graph(
    nodes: int, begin: Int[np.ndarray, "k"], end: Int[np.ndarray, "k"], length: Float[np.ndarray, "k"]
) -> csr_array:
    """Build the sparse ``(nodes, nodes)`` graph of undirected edges, each stored once."""
    return csr_array((length, (begin, end)), shape=(nodes, nodes))
