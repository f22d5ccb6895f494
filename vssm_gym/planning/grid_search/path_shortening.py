"""Shorten a grid path to an any-angle path: ``min sum w |p_i+1 - p_i|`` with sufficient clearance everywhere (eq. P5).

A path is feasible when every point of every segment has the clearance that :class:`ClearanceRequirement` asks for.
Every move below keeps a path feasible and lowers its cost (eq. P2b), which is its length where the space has no weight:
the result never costs more than the path it started from.
Coordinates are grid cells; clearances are metres.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.planning.clearance import ClearanceMap, bilinear
from vssm_gym.planning.grid_search.clearance_requirement import ClearanceRequirement, required_at, segment_free
from vssm_gym.planning.grid_search.path_cost import path_cost, segment_cost

# Effort of the local search, chosen on furnished apartments with cells of 2.5 cm.
SWEEPS = 12  # of all moves over all bends, at most; 3 to 6 are enough there
GAIN = 0.02  # cells; a sweep that saves less is the last: 0.5 mm
ADDED_SPACING = 6.0  # cells between the points that are added to a segment as ends of shortcuts: 15 cm
SHARP = 0.6  # rad; a sharper bend is split in two, because two bends follow the arc around a corner more closely


@njit(cache=True, nogil=True)
def _bend_free(clearance, px, py, required):
    return bilinear(clearance, px, py) >= required_at(required, px, py)


@njit(cache=True, nogil=True)
def _resample(clearance, path, required):
    """Return the same path with more points on it where a bend would be allowed.

    Two bends may block each other, when each can be reached from the other only where it is. The points free them.
    """
    count = 1
    for i in range(path.shape[0] - 1):
        count += 1 + int(math.hypot(path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]) / ADDED_SPACING)
    out = np.empty((count, 2))
    out[0] = path[0]
    count = 1
    for i in range(path.shape[0] - 1):
        dx, dy = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        pieces = 1 + int(math.hypot(dx, dy) / ADDED_SPACING)
        for k in range(1, pieces):
            px, py = path[i, 0] + dx * k / pieces, path[i, 1] + dy * k / pieces
            if _bend_free(clearance, px, py, required):
                out[count, 0], out[count, 1] = px, py
                count += 1
        out[count] = path[i + 1]
        count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def _skip_bends(clearance, weight, resolution, path, required):
    """Connect each kept bend to the last point of the path that a free segment reaches at no higher cost."""
    n = path.shape[0]
    along = np.zeros(n)
    for i in range(n - 1):
        along[i + 1] = along[i] + segment_cost(weight, path[i, 0], path[i, 1], path[i + 1, 0], path[i + 1, 1])
    keep = np.empty(n, np.int64)
    keep[0], count, i = 0, 1, 0
    while i < n - 1:
        j = n - 1
        while j > i + 1:
            straight = segment_cost(weight, path[i, 0], path[i, 1], path[j, 0], path[j, 1])
            if straight <= along[j] - along[i] + 1e-9 and segment_free(
                clearance, resolution, path[i, 0], path[i, 1], path[j, 0], path[j, 1], required
            ):
                break
            j -= 1
        keep[count] = j
        count += 1
        i = j
    return path[keep[:count]]


@njit(cache=True, nogil=True)
def _move_bend(clearance, weight, resolution, path, i, required):
    """Move bend ``i`` by a pattern search to where the path costs least; the step halves from 4 to 1/8 cell."""
    ax, ay, bx, by = path[i - 1, 0], path[i - 1, 1], path[i + 1, 0], path[i + 1, 1]
    x, y = path[i, 0], path[i, 1]
    best = segment_cost(weight, ax, ay, x, y) + segment_cost(weight, x, y, bx, by)
    step = 4.0
    while step > 0.1:
        moved = False
        for k in range(12):
            px, py = x + step * math.cos(k * math.pi / 6), y + step * math.sin(k * math.pi / 6)
            # The straight lengths bound the cost from below, and are cheaper to compute.
            if math.hypot(px - ax, py - ay) + math.hypot(bx - px, by - py) >= best - 1e-4:
                continue
            cost = segment_cost(weight, ax, ay, px, py) + segment_cost(weight, px, py, bx, by)
            if cost < best - 1e-4 and _bend_free(clearance, px, py, required):
                if not segment_free(clearance, resolution, ax, ay, px, py, required):
                    continue
                if segment_free(clearance, resolution, px, py, bx, by, required):
                    x, y, best, moved = px, py, cost, True
                    break
        if not moved:
            step *= 0.5
    path[i, 0], path[i, 1] = x, y


@njit(cache=True, nogil=True)
def _shorten_end(clearance, weight, resolution, path, gx, gy, radius, required):
    """Move the last point along the rim of the goal's disc (radius in cells) to where the last segment enters it."""
    n = path.shape[0]
    ax, ay = path[n - 2, 0], path[n - 2, 1]
    to_goal = math.hypot(gx - ax, gy - ay)
    if to_goal <= radius:
        return
    best = segment_cost(weight, ax, ay, path[n - 1, 0], path[n - 1, 1])
    aim = math.atan2(ay - gy, ax - gx)
    here = math.atan2(path[n - 1, 1] - gy, path[n - 1, 0] - gx) - aim
    here = math.atan2(math.sin(here), math.cos(here))
    for k in range(
        33
    ):  # from the rim's nearest point round to where the path ends now: the first free one that costs less
        angle = aim + here * k / 32
        px, py = gx + radius * math.cos(angle), gy + radius * math.sin(angle)
        if math.hypot(px - ax, py - ay) >= best:
            return
        if segment_cost(weight, ax, ay, px, py) >= best:
            continue
        if _bend_free(clearance, px, py, required) and segment_free(clearance, resolution, ax, ay, px, py, required):
            path[n - 1, 0], path[n - 1, 1] = px, py
            return


@njit(cache=True, nogil=True)
def _split_sharp_bends(clearance, weight, resolution, path, required):
    """Replace each sharp bend by two on a circle around the corner, whose tangents keep ``required.limit`` from it."""
    n = path.shape[0]
    out = np.empty((2 * n, 2))
    out[0] = path[0]
    count = 1
    for i in range(1, n - 1):
        v, a, b = path[i], out[count - 1], path[i + 1]
        da, db = math.hypot(a[0] - v[0], a[1] - v[1]), math.hypot(b[0] - v[0], b[1] - v[1])
        out[count] = v
        count += 1
        if da < 1e-6 or db < 1e-6:
            continue
        ix, iy = (a[0] - v[0]) / da + (b[0] - v[0]) / db, (a[1] - v[1]) / da + (b[1] - v[1]) / db
        inward = math.hypot(ix, iy)  # 2 sin(bend / 2)
        if inward < 2.0 * math.sin(0.5 * SHARP) or inward > 1.99:
            continue
        bend = 2.0 * math.asin(0.5 * inward)
        reach = bilinear(clearance, v[0], v[1]) / resolution  # to the corner, which lies on the bend's inner side
        cx, cy = v[0] + reach * ix / inward, v[1] + reach * iy / inward
        radius = required.limit / math.cos(0.25 * bend) / resolution
        outward = math.atan2(-iy, -ix)
        side = 1.0 if (a[0] - v[0]) * -iy + (a[1] - v[1]) * ix < 0.0 else -1.0
        one, two = outward + side * 0.25 * bend, outward - side * 0.25 * bend
        px, py = cx + radius * math.cos(one), cy + radius * math.sin(one)
        qx, qy = cx + radius * math.cos(two), cy + radius * math.sin(two)
        before = segment_cost(weight, a[0], a[1], v[0], v[1]) + segment_cost(weight, v[0], v[1], b[0], b[1])
        after = segment_cost(weight, a[0], a[1], px, py) + segment_cost(weight, px, py, qx, qy)
        after += segment_cost(weight, qx, qy, b[0], b[1])
        if after >= before - GAIN:
            continue
        if not (_bend_free(clearance, px, py, required) and _bend_free(clearance, qx, qy, required)):
            continue
        if (
            segment_free(clearance, resolution, a[0], a[1], px, py, required)
            and segment_free(clearance, resolution, px, py, qx, qy, required)
            and segment_free(clearance, resolution, qx, qy, b[0], b[1], required)
        ):
            out[count - 1, 0], out[count - 1, 1] = px, py
            out[count, 0], out[count, 1] = qx, qy
            count += 1
    out[count] = path[n - 1]
    return out[: count + 1].copy()


@njit(cache=True, nogil=True)
def shorten_cells(
    clearance: np.ndarray,
    weight: np.ndarray,
    resolution: float,
    path: np.ndarray,
    gx: float,
    gy: float,
    radius: float,
    required: ClearanceRequirement,
) -> np.ndarray:
    """Shorten a feasible path ``(n, 2)`` in cells; its end may move within the disc ``radius`` of the goal."""
    path = _skip_bends(clearance, weight, resolution, path, required)
    cost = path_cost(weight, path)
    for _ in range(SWEEPS):
        if path.shape[0] < 2:
            break
        for i in range(1, path.shape[0] - 1):
            _move_bend(clearance, weight, resolution, path, i, required)
        _shorten_end(clearance, weight, resolution, path, gx, gy, radius, required)
        path = _skip_bends(clearance, weight, resolution, _resample(clearance, path, required), required)
        path = _split_sharp_bends(clearance, weight, resolution, path, required)
        cheaper = path_cost(weight, path)
        if cheaper > cost - GAIN:
            break
        cost = cheaper
    return path


@njit(cache=True, nogil=True)
def _cheapest_entry(clearance, weight, resolution, path, required):
    """Return the later point by which the path costs least from its first one, of those in sight; 0 where none is."""
    best, least, left = 0, np.inf, 0.0
    for k in range(path.shape[0] - 1, 0, -1):
        if k < path.shape[0] - 1:
            left += segment_cost(weight, path[k, 0], path[k, 1], path[k + 1, 0], path[k + 1, 1])
        total = segment_cost(weight, path[0, 0], path[0, 1], path[k, 0], path[k, 1]) + left
        if total < least - 1e-9 and segment_free(
            clearance, resolution, path[0, 0], path[0, 1], path[k, 0], path[k, 1], required
        ):
            best, least = k, total
    return best


def shorten_path(
    clearance_map: ClearanceMap, path: np.ndarray, goal: np.ndarray, goal_radius: float, required: ClearanceRequirement
) -> np.ndarray | None:
    """Shorten a world-frame polyline ``(n, 2)`` (m) from its first point; None where no later point can be reached.

    A robot follows its plan by this: the first point is its position now, the others are the rest of the plan.
    """
    cells = clearance_map.to_grid(path)
    c, w, r = clearance_map.clearance, clearance_map.weights, clearance_map.resolution
    k = _cheapest_entry(c, w, r, cells, required)
    if k == 0:
        return None
    gx, gy = clearance_map.to_grid(goal)
    left = np.concatenate([cells[:1], cells[k:]])
    return clearance_map.to_world(shorten_cells(c, w, r, left, gx, gy, goal_radius / r, required))
