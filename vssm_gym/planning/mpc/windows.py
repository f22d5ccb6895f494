"""Prepare uniform cubic B-spline coefficients of the two tables, and the windows that one plan can reach.

s(g) = sum_k b_k(g - floor(g)) c[floor(g) - 1 + k],  k = 0..3     (in every dimension; g in cells)
"""

import math

import numpy as np
from scipy.ndimage import spline_filter

from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.fields import walled
from vssm_gym.planning.value_iteration import CostToGo

SUPPORT = 4  # coefficients that a cubic B-spline reads in each dimension


class ValueTable:
    """Hold coefficients of ``J``, its values: a B-spline of them is a blurred, bounded, C2 interpolant."""

    def __init__(self, value: CostToGo, reach: float) -> None:
        table = np.asarray(value.values, dtype=np.float32)
        self.resolution, self.headings = float(value.resolution), table.shape[2]
        self.cells = 2 * math.ceil(reach / self.resolution) + SUPPORT  # of a window's side
        # where the spline has all its coefficients, from the window's first one on, m
        self.inner = np.array([1.0, self.cells - 3.0]) * self.resolution
        # heading k - 1 comes first and the first two come again at the end: no index ever wraps
        table = np.concatenate([table[..., -1:], table, table[..., :2]], axis=2)
        around = ((self.cells,) * 2, (self.cells,) * 2, (0, 0))
        self.table = np.pad(table, around, constant_values=np.float32(value.never))
        self.origin = np.asarray(value.origin, np.float64) - self.cells * self.resolution

    def window(self, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return coefficients ``(cells, cells, headings + 3)`` flat, and the place of the first, ``(2,)`` m."""
        start = _start(centre, self.origin, self.resolution, self.cells, self.table.shape)
        i, j = start
        return self.table[i : i + self.cells, j : j + self.cells].ravel(), self.origin + self.resolution * start


class ClearanceTable:
    """Hold spline coefficients of the clearance, which falls off at a slope of one beyond the grid."""

    def __init__(self, clearance: ClearanceMap, reach: float) -> None:
        self.resolution = float(clearance.resolution)
        self.cells = 2 * math.ceil(reach / self.resolution) + SUPPORT
        inside = walled(clearance)
        beyond_x, beyond_y = (self.resolution * self._beyond(n) for n in inside.shape)
        beyond = beyond_x[:, None] + beyond_y[None, :]
        self.table = spline_filter(np.pad(inside, self.cells, mode="edge") - beyond, order=3, mode="nearest")
        self.origin = np.asarray(clearance.origin, np.float64) - self.cells * self.resolution

    def _beyond(self, n: int) -> np.ndarray:
        """Return how many cells outside an axis of ``n`` cells those of the padded axis are."""
        k = np.arange(-self.cells, n + self.cells)
        return np.maximum(0, np.maximum(-k, k - n + 1))

    def window(self, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return coefficients ``(cells, cells)`` flat, and the place of the first, ``(2,)`` m."""
        start = _start(centre, self.origin, self.resolution, self.cells, self.table.shape)
        i, j = start
        return self.table[i : i + self.cells, j : j + self.cells].ravel(), self.origin + self.resolution * start


def _start(centre: np.ndarray, origin: np.ndarray, resolution: float, cells: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the index of a window's first cell; ``centre`` lies in its middle where the table reaches that far."""
    start = np.round((np.asarray(centre) - origin) / resolution).astype(int) - cells // 2
    return np.clip(start, 0, np.array(shape[:2]) - cells)
