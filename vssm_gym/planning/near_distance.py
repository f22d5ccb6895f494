"""``d(c) = min(|c - nearest crossing|, reach)``: distances to surfaces that are near, in a fraction of the time.

A robot that plans in a growing map needs the clearance anew at every step, and never asks for more than it can use.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.maps.columns import level_crossings


def near_level_distance(depth: np.ndarray, resolution: float, reach: float) -> np.ndarray:
    """Return :func:`~vssm_gym.maps.columns.level_distance` up to ``reach`` (m), and ``reach`` beyond.

    Args:
        depth: ``(nx, ny)`` m, positive inside obstacles.
        resolution: m between cell centres.
        reach: m.

    Returns:
        ``(nx, ny)`` float32 signed distances, m.
    """
    inside, surface = level_crossings(depth, resolution)
    distance = resolution * _nearest(inside.shape[0], inside.shape[1], surface, reach / resolution)
    return np.ascontiguousarray(np.where(inside, -distance, distance), dtype=np.float32)


@njit(cache=True, nogil=True)
def _nearest(nx: int, ny: int, points: np.ndarray, reach: float) -> np.ndarray:
    """Return each cell's distance to the nearest point, at most ``reach``; all in cells."""
    squared = np.full((nx, ny), reach * reach)
    for k in range(points.shape[0]):
        x, y = points[k, 0], points[k, 1]
        for i in range(max(0, math.ceil(x - reach)), min(nx, math.floor(x + reach) + 1)):
            for j in range(max(0, math.ceil(y - reach)), min(ny, math.floor(y + reach) + 1)):
                away = (i - x) * (i - x) + (j - y) * (j - y)
                if away < squared[i, j]:
                    squared[i, j] = away
    return np.sqrt(squared)
