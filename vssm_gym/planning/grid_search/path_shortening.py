"""Any-angle paths: a grid path pulled taut, ``min sum |p_i+1 - p_i|`` with every segment and every bend clear enough.

A path is feasible when all of every segment has the clearance that :class:`Need` asks for. Every move below keeps a
path feasible and shortens it, so the result is never longer than what it started from. Coordinates are grid cells;
clearances are metres.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.planning.clearance import ClearanceMap, bilinear
from vssm_gym.planning.grid_search.clearance_requirement import Need, need_at, segment_free

SWEEPS = 12  # of all moves over all bends; a path of a furnished apartment is taut after 3 to 6
GAIN = 0.02  # cells: a sweep that shortens the path by less ends the work
SPACING = 6.0  # cells between the points of a segment that a shortcut may lead to
SHARP = 0.6  # rad: a sharper bend is split in two, since one bend cuts a corner's arc worse than two


@njit(cache=True, nogil=True)
def _bend_free(clearance, px, py, need):
    return bilinear(clearance, px, py) >= need_at(need, px, py)


@njit(cache=True, nogil=True)
def _resample(clearance, path, need):
    """The same path with more points on it where a bend would be allowed.

    Two bends that hold each other in place, each in sight of the other only where it is, come free through them.
    """
    count = 1
    for i in range(path.shape[0] - 1):
        count += 1 + int(math.hypot(path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]) / SPACING)
    out = np.empty((count, 2))
    out[0] = path[0]
    count = 1
    for i in range(path.shape[0] - 1):
        dx, dy = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        pieces = 1 + int(math.hypot(dx, dy) / SPACING)
        for k in range(1, pieces):
            px, py = path[i, 0] + dx * k / pieces, path[i, 1] + dy * k / pieces
            if _bend_free(clearance, px, py, need):
                out[count, 0], out[count, 1] = px, py
                count += 1
        out[count] = path[i + 1]
        count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def _pull(clearance, resolution, path, need):
    """From each kept bend go straight to the last point of the path that is in sight."""
    n = path.shape[0]
    keep = np.empty(n, np.int64)
    keep[0], count, i = 0, 1, 0
    while i < n - 1:
        j = n - 1
        while j > i + 1 and not segment_free(
            clearance, resolution, path[i, 0], path[i, 1], path[j, 0], path[j, 1], need
        ):
            j -= 1
        keep[count] = j
        count += 1
        i = j
    return path[keep[:count]]


@njit(cache=True, nogil=True)
def _slide(clearance, resolution, path, i, need):
    """Pattern search for the place of bend ``i`` that shortens the path most; the step halves from 4 to 1/8 cell."""
    ax, ay, bx, by = path[i - 1, 0], path[i - 1, 1], path[i + 1, 0], path[i + 1, 1]
    x, y = path[i, 0], path[i, 1]
    best = math.hypot(x - ax, y - ay) + math.hypot(bx - x, by - y)
    step = 4.0
    while step > 0.1:
        moved = False
        for k in range(12):
            px, py = x + step * math.cos(k * math.pi / 6), y + step * math.sin(k * math.pi / 6)
            length = math.hypot(px - ax, py - ay) + math.hypot(bx - px, by - py)
            if length < best - 1e-4 and _bend_free(clearance, px, py, need):
                if not segment_free(clearance, resolution, ax, ay, px, py, need):
                    continue
                if segment_free(clearance, resolution, px, py, bx, by, need):
                    x, y, best, moved = px, py, length, True
                    break
        if not moved:
            step *= 0.5
    path[i, 0], path[i, 1] = x, y


@njit(cache=True, nogil=True)
def _shorten_end(clearance, resolution, path, gx, gy, radius, need):
    """Move the last point along the goal disc's rim (radius in cells) to where the last segment first touches it."""
    n = path.shape[0]
    ax, ay = path[n - 2, 0], path[n - 2, 1]
    to_goal = math.hypot(gx - ax, gy - ay)
    if to_goal <= radius:
        return
    best = math.hypot(path[n - 1, 0] - ax, path[n - 1, 1] - ay)
    aim = math.atan2(ay - gy, ax - gx)
    here = math.atan2(path[n - 1, 1] - gy, path[n - 1, 0] - gx) - aim
    here = math.atan2(math.sin(here), math.cos(here))
    for k in range(33):  # from the rim's nearest point round to where the path ends now: the first free one is shortest
        angle = aim + here * k / 32
        px, py = gx + radius * math.cos(angle), gy + radius * math.sin(angle)
        if math.hypot(px - ax, py - ay) >= best:
            return
        if _bend_free(clearance, px, py, need) and segment_free(clearance, resolution, ax, ay, px, py, need):
            path[n - 1, 0], path[n - 1, 1] = px, py
            return


@njit(cache=True, nogil=True)
def _split(clearance, resolution, path, need):
    """Replace sharp bends by two on a circle around the corner, whose tangents keep ``need.limit`` from it."""
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
        radius = need.limit / math.cos(0.25 * bend) / resolution
        outward = math.atan2(-iy, -ix)
        side = 1.0 if (a[0] - v[0]) * -iy + (a[1] - v[1]) * ix < 0.0 else -1.0
        one, two = outward + side * 0.25 * bend, outward - side * 0.25 * bend
        px, py = cx + radius * math.cos(one), cy + radius * math.sin(one)
        qx, qy = cx + radius * math.cos(two), cy + radius * math.sin(two)
        length = math.hypot(px - a[0], py - a[1]) + math.hypot(qx - px, qy - py) + math.hypot(b[0] - qx, b[1] - qy)
        if length >= da + db - GAIN:
            continue
        if not (_bend_free(clearance, px, py, need) and _bend_free(clearance, qx, qy, need)):
            continue
        if (
            segment_free(clearance, resolution, a[0], a[1], px, py, need)
            and segment_free(clearance, resolution, px, py, qx, qy, need)
            and segment_free(clearance, resolution, qx, qy, b[0], b[1], need)
        ):
            out[count - 1, 0], out[count - 1, 1] = px, py
            out[count, 0], out[count, 1] = qx, qy
            count += 1
    out[count] = path[n - 1]
    return out[: count + 1].copy()


@njit(cache=True, nogil=True)
def _length(path):
    total = 0.0
    for i in range(path.shape[0] - 1):
        total += math.hypot(path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1])
    return total


@njit(cache=True, nogil=True)
def pull_taut(
    clearance: np.ndarray, resolution: float, path: np.ndarray, gx: float, gy: float, radius: float, need: Need
) -> np.ndarray:
    """The taut form of a feasible path ``(n, 2)`` in cells; its end may move within the disc ``radius`` of the goal."""
    path = _pull(clearance, resolution, path, need)
    length = _length(path)
    for _ in range(SWEEPS):
        if path.shape[0] < 2:
            break
        for i in range(1, path.shape[0] - 1):
            _slide(clearance, resolution, path, i, need)
        _shorten_end(clearance, resolution, path, gx, gy, radius, need)
        path = _pull(clearance, resolution, _resample(clearance, path, need), need)
        path = _split(clearance, resolution, path, need)
        shorter = _length(path)
        if shorter > length - GAIN:
            break
        length = shorter
    return path


def tighten(
    clearance_map: ClearanceMap, path: np.ndarray, goal: np.ndarray, goal_radius: float, need: Need
) -> np.ndarray | None:
    """Pull a world-frame polyline ``(n, 2)`` taut, from its first point; None where no later point is in sight of it.

    The robot's way of following: the first point is where it stands now, the others are what is left of its plan.
    """
    cells = clearance_map.to_grid(path)
    c, r = clearance_map.clearance, clearance_map.resolution
    for k in range(len(cells) - 1, 0, -1):
        if segment_free(c, r, cells[0, 0], cells[0, 1], cells[k, 0], cells[k, 1], need):
            gx, gy = clearance_map.to_grid(goal)
            left = np.concatenate([cells[:1], cells[k:]])
            return clearance_map.to_world(pull_taut(c, r, left, gx, gy, goal_radius / r, need))
    return None
