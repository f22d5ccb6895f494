"""Compute every cell's distance to a goal, around obstacles, by Dijkstra over 16 neighbours (eq. P6).

    d(cell) = min over paths through passable cells of sum |edges|

Paths of the grid are up to 2.7 % longer than a straight line. The ends of an edge must be passable. The cells between
them are not tested, because what is passable for a car's axle is bounded by obstacles much wider than an edge.
"""

import numpy as np
from numba import njit

from vssm_gym.geometry.grid_graph import LENGTHS, MOVES
from vssm_gym.planning.grid_search.heap import pop, sift_up


@njit(cache=True, nogil=True)
def goal_distance(passable: np.ndarray, gx: float, gy: float) -> np.ndarray:
    """Return distances ``(nx, ny)`` float32 in cells to the point ``(gx, gy)`` in cells; infinite where no path leads.

    The cells around the goal are its seeds, passable or not: their distance is the straight line.
    """
    nx, ny = passable.shape
    key = np.full(nx * ny, np.inf)
    place = np.full(nx * ny, -1, np.int32)
    heap = np.empty(nx * ny, np.int32)
    size = 0
    for i in range(int(np.floor(gx)), int(np.floor(gx)) + 2):
        for j in range(int(np.floor(gy)), int(np.floor(gy)) + 2):
            if 0 <= i < nx and 0 <= j < ny:
                node = i * ny + j
                key[node] = np.hypot(i - gx, j - gy)
                heap[size] = node
                size += 1
                sift_up(heap, place, key, size - 1)
    while size > 0:
        node = pop(heap, place, key, size)
        size -= 1
        place[node] = -2
        i, j = node // ny, node % ny
        for m in range(MOVES.shape[0]):
            a, b = i + MOVES[m, 0], j + MOVES[m, 1]
            if not (0 <= a < nx and 0 <= b < ny) or not passable[a, b]:
                continue
            other, through = a * ny + b, key[node] + LENGTHS[m]
            if through < key[other] and place[other] != -2:
                key[other] = through
                if place[other] == -1:
                    heap[size], place[other] = other, size
                    size += 1
                sift_up(heap, place, key, place[other])
    return key.reshape(nx, ny).astype(np.float32)
