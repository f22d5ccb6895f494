"""The clearance that a path must keep, and whether a segment keeps it: ``c >= min(limit, base + slope |xy - start|)``.

A path is feasible when all of every segment has that clearance. Coordinates are grid cells; clearances are metres.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.planning.clearance import ClearanceMap, bilinear

ESCAPE_SLOPE = 0.3  # clearance gained a metre when leaving a tight place: off a wall at 17 degrees


class Need(NamedTuple):
    """Clearance (m) asked for at a place: ``min(limit, base + slope * |xy - (x, y)|)``.

    The ramp lets a robot leave a place that is too near to an obstacle: what is asked grows from what it has now.
    """

    limit: float  # m
    x: float  # cells, where the ramp starts: the robot
    y: float
    base: float  # m, infinite where the robot stands clear
    slope: float  # m a cell


@njit(cache=True, nogil=True)
def need_at(need: Need, x: float, y: float) -> float:
    """Return the clearance (m) asked for at cell coordinates ``(x, y)``; see :class:`Need`."""
    if need.base >= need.limit:
        return need.limit
    return min(need.limit, need.base + need.slope * math.hypot(x - need.x, y - need.y))


@njit(cache=True, nogil=True)
def segment_free(
    clearance: np.ndarray, resolution: float, ax: float, ay: float, bx: float, by: float, need: Need
) -> bool:
    """Return whether the clearance along all of the segment is at least what is needed.

    A clearance falls by at most the distance moved, so the walk steps as far as the slack allows, half a cell at least.
    """
    length = math.hypot(bx - ax, by - ay)
    if length == 0.0:
        return True
    ux, uy = (bx - ax) / length, (by - ay) / length
    rate = resolution + (need.slope if need.base < need.limit else 0.0)
    t = 0.0
    while True:
        x, y = ax + t * ux, ay + t * uy
        slack = bilinear(clearance, x, y) - need_at(need, x, y)
        if slack < 0.0:
            return False
        if t >= length:
            return True
        t = min(length, t + max(0.5, 0.9 * slack / rate))  # 0.9: the interpolation may fall a little faster


def needed(clearance_map: ClearanceMap, start: np.ndarray, clearance: float) -> Need:
    """Ask for ``clearance`` (m) everywhere; from a start ``(2,)`` that has less, for what it has and a ramp from there.

    The ramp rises by :data:`ESCAPE_SLOPE`.
    """
    r = clearance_map.resolution
    x, y = (float(v) for v in clearance_map.to_grid(start))
    have = bilinear(clearance_map.clearance, x, y)
    # The ramp starts so much lower that at least the best corner of the start's own cell is open to it.
    base = have - ESCAPE_SLOPE * math.sqrt(2.0) * r
    return Need(clearance, x, y, base if have < clearance else math.inf, ESCAPE_SLOPE * r)
