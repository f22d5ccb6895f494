"""Compute the cost of paths: ``sum over segments of integral of w ds``, with a weight w >= 1 a metre (eq. P2b).

A weight charges a path for what clearance alone does not forbid: nearness to obstacles, unknown space, places where the
pose estimate is poor. Where the weight is 1 everywhere, the cost is the length. Coordinates are grid cells.
"""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def segment_cost(weight: np.ndarray, ax: float, ay: float, bx: float, by: float) -> float:
    """Return the cost (cells) of a straight segment within the grid; its length for ``clearance.UNIFORM``.

    The weight is interpolated bilinearly at the middle of pieces no longer than half a cell: with that of the nearest
    cell, a path would bend by a centimetre to pass a cell's border earlier.
    """
    length = math.hypot(bx - ax, by - ay)
    if weight.shape[0] == 0 or length == 0.0:
        return length
    pieces = int(2.0 * length) + 1
    total = 0.0
    for k in range(pieces):
        t = (k + 0.5) / pieces
        x = min(max(ax + t * (bx - ax), 0.0), weight.shape[0] - 1.0)
        y = min(max(ay + t * (by - ay), 0.0), weight.shape[1] - 1.0)
        i, j = min(int(x), weight.shape[0] - 2), min(int(y), weight.shape[1] - 2)
        a, b = x - i, y - j
        low = (1.0 - b) * weight[i, j] + b * weight[i, j + 1]
        total += (1.0 - a) * low + a * ((1.0 - b) * weight[i + 1, j] + b * weight[i + 1, j + 1])
    return total * length / pieces


@njit(cache=True, nogil=True)
def path_cost(weight: np.ndarray, path: np.ndarray) -> float:
    """Return the cost (cells) of a polyline ``(n, 2)``."""
    total = 0.0
    for i in range(path.shape[0] - 1):
        total += segment_cost(weight, path[i, 0], path[i, 1], path[i + 1, 0], path[i + 1, 1])
    return total
