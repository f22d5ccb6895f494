"""Define the clearance that a path must keep: ``c >= min(limit, base + slope |xy - start|)`` (eq. P2).

A path is feasible when every point of every segment has that clearance. Coordinates are grid cells; clearances are
metres.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.planning.clearance import ClearanceMap, bilinear

ESCAPE_SLOPE = 0.3  # clearance that is gained per metre out of a tight place: 17 degrees off a wall


class ClearanceRequirement(NamedTuple):
    """Require the clearance ``min(limit, base + slope * |xy - (x, y)|)``, m.

    The ramp lets a robot leave a place that is too near to an obstacle: the requirement grows from its clearance now.
    """

    limit: float  # m
    x: float  # cells, where the ramp starts: the robot
    y: float
    base: float  # m, infinite where the robot stands clear
    slope: float  # m a cell


@njit(cache=True, nogil=True)
def required_at(required: ClearanceRequirement, x: float, y: float) -> float:
    """Return the clearance (m) that is required at cell coordinates ``(x, y)``."""
    if required.base >= required.limit:
        return required.limit
    return min(required.limit, required.base + required.slope * math.hypot(x - required.x, y - required.y))


@njit(cache=True, nogil=True)
def segment_free(
    clearance: np.ndarray, resolution: float, ax: float, ay: float, bx: float, by: float, required: ClearanceRequirement
) -> bool:
    """Return True where the clearance along the whole segment is at least what is required.

    A clearance falls by at most the distance moved, so each step is as long as the slack allows, half a cell at least.
    """
    length = math.hypot(bx - ax, by - ay)
    if length == 0.0:
        return True
    ux, uy = (bx - ax) / length, (by - ay) / length
    rate = resolution + (required.slope if required.base < required.limit else 0.0)
    t = 0.0
    while True:
        x, y = ax + t * ux, ay + t * uy
        slack = bilinear(clearance, x, y) - required_at(required, x, y)
        if slack < 0.0:
            return False
        if t >= length:
            return True
        t = min(length, t + max(0.5, 0.9 * slack / rate))  # 0.9: the interpolation may fall a little faster


@njit(cache=True, nogil=True)
def path_free(clearance: np.ndarray, resolution: float, path: np.ndarray, required: ClearanceRequirement) -> bool:
    """Return True where every segment of a path ``(n, 2)``, in cells, has the clearance that is required."""
    for k in range(path.shape[0] - 1):
        a, b = path[k], path[k + 1]
        if not segment_free(clearance, resolution, a[0], a[1], b[0], b[1], required):
            return False
    return True


def requirement_from(clearance_map: ClearanceMap, start: np.ndarray, clearance: float) -> ClearanceRequirement:
    """Require ``clearance`` (m) everywhere, and along a ramp from a start ``(2,)`` (m) that has less.

    The ramp rises by :data:`ESCAPE_SLOPE` from the clearance at the start.
    """
    r = clearance_map.resolution
    x, y = (float(v) for v in clearance_map.to_grid(start))
    have = bilinear(clearance_map.clearance, x, y)
    # The ramp starts so much lower that at least the best corner of the start's own cell is open to it.
    base = have - ESCAPE_SLOPE * math.sqrt(2.0) * r
    return ClearanceRequirement(clearance, x, y, base if have < clearance else math.inf, ESCAPE_SLOPE * r)
