"""A* over a uniform 2D grid: ``min sum |edges|`` to the goal's region, then pulled taut (SPEC 6, TNP-SM planner).

Nodes are the cells of a :class:`ClearanceMap`, each joined to 16 neighbours. An edge needs its whole segment free and a
minimum clearance at its end; its cost is its length; the heuristic is the Euclidean distance to the goal's disc. The
robot may stand closer to an obstacle than the planner would ever go: what is asked then grows from what it has.
"""

import math
import time

import numpy as np
from numba import njit

from vssm_gym.grid_graph import LENGTHS, MOVES, edge_free
from vssm_gym.planning.clearance import ClearanceMap, bilinear
from vssm_gym.planning.heap import pop, sift_up
from vssm_gym.planning.result import PlanResult, PlanStatus
from vssm_gym.planning.taut import Need, need_at, pull_taut, segment_free

ESCAPE_SLOPE = 0.3  # clearance gained a metre when leaving a tight place: off a wall at 17 degrees
ESCAPE_DEPTH = 0.15  # m inside an obstacle from which the planner still tries to leave; deeper means a lost estimate

_FOUND, _NO_PATH, _TIME_OUT = 0, 1, 2


@njit(cache=True, nogil=True)
def _free_cells(clearance, need):
    """Which cells have the clearance that is needed; uint8 ``(nx, ny)``."""
    free = np.empty(clearance.shape, np.uint8)
    for i in range(clearance.shape[0]):
        for j in range(clearance.shape[1]):
            free[i, j] = clearance[i, j] >= need_at(need, i, j)
    return free


@njit(cache=True, nogil=True)
def search(
    free: np.ndarray, seeds: np.ndarray, gx: float, gy: float, radius: float, max_expansions: int
) -> tuple[int, np.ndarray, float, int]:
    """A* from ``seeds`` (rows ``i, j, cost so far``) to the first node within ``radius`` of ``(gx, gy)``; all in cells.

    Returns:
        Code, nodes of the path ``(n, 2)``, its cost in cells, closed nodes. After a time-out the path leads to the
        closed node with the least heuristic.
    """
    nx, ny = free.shape
    cost = np.full(nx * ny, np.inf)
    key = np.empty(nx * ny)
    parent = np.full(nx * ny, -1, np.int32)
    place = np.full(nx * ny, -1, np.int32)  # -1 unseen, -2 closed, else the position in the heap
    heap = np.empty(nx * ny, np.int32)
    size = 0
    for k in range(seeds.shape[0]):
        i, j = int(seeds[k, 0]), int(seeds[k, 1])
        node = i * ny + j
        cost[node] = seeds[k, 2]
        key[node] = cost[node] + max(0.0, math.hypot(i - gx, j - gy) - radius)
        heap[size] = node
        size += 1
        sift_up(heap, place, key, size - 1)
    closed, nearest, least, code = 0, -1, np.inf, _NO_PATH
    while size > 0:
        node = pop(heap, place, key, size)
        size -= 1
        place[node] = -2
        closed += 1
        i, j = node // ny, node % ny
        away = math.hypot(i - gx, j - gy) - radius
        if away < least:
            nearest, least = node, away
        if away <= 0.0:
            code = _FOUND
            break
        if closed >= max_expansions:
            code = _TIME_OUT
            break
        for m in range(MOVES.shape[0]):
            di, dj = MOVES[m, 0], MOVES[m, 1]
            if not (0 <= i + di < nx and 0 <= j + dj < ny):
                continue
            other = (i + di) * ny + j + dj
            through = cost[node] + LENGTHS[m]
            # Cheap tests first: most neighbours are reached already. Rounding may make a closed node look cheaper.
            if through >= cost[other] or place[other] == -2:
                continue
            if edge_free(free, i, j, di, dj):
                cost[other], parent[other] = through, node
                key[other] = through + max(0.0, math.hypot(i + di - gx, j + dj - gy) - radius)
                if place[other] == -1:
                    heap[size], place[other] = other, size
                    size += 1
                sift_up(heap, place, key, place[other])
    if code == _NO_PATH:
        return code, np.empty((0, 2)), np.inf, closed
    count, node = 0, nearest
    while node >= 0:
        count, node = count + 1, parent[node]
    path, node = np.empty((count, 2)), nearest
    for k in range(count - 1, -1, -1):
        path[k, 0], path[k, 1] = node // ny, node % ny
        node = parent[node]
    return code, path, cost[nearest], closed


@njit(cache=True, nogil=True)
def _seeds(clearance, resolution, free, x, y, need):
    """The corners of the start's cell that it can reach in a straight line: rows ``i, j, distance``."""
    rows = np.empty((4, 3))
    count = 0
    for k in range(4):
        i, j = math.floor(x) + (k & 1), math.floor(y) + (k >> 1)
        if not (0 <= i < free.shape[0] and 0 <= j < free.shape[1]) or not free[i, j]:
            continue
        if segment_free(clearance, resolution, x, y, float(i), float(j), need):
            rows[count, 0], rows[count, 1], rows[count, 2] = i, j, math.hypot(i - x, j - y)
            count += 1
    return rows[:count]


@njit(cache=True, nogil=True)
def _goal_free(free, gx, gy, radius):
    for i in range(max(0, int(gx - radius)), min(free.shape[0], int(gx + radius) + 2)):
        for j in range(max(0, int(gy - radius)), min(free.shape[1], int(gy + radius) + 2)):
            if free[i, j] and math.hypot(i - gx, j - gy) <= radius:
                return True
    return False


def needed(clearance_map: ClearanceMap, start: np.ndarray, clearance: float) -> Need:
    """What a path from ``start`` must keep: ``clearance`` (m) everywhere; from a start that has less, what it has and a
    ramp of :data:`ESCAPE_SLOPE` from there.
    """
    r = clearance_map.resolution
    x, y = (float(v) for v in clearance_map.to_grid(start))
    have = bilinear(clearance_map.clearance, x, y)
    # The ramp starts so much lower that at least the best corner of the start's own cell is open to it.
    base = have - ESCAPE_SLOPE * math.sqrt(2.0) * r
    return Need(clearance, x, y, base if have < clearance else math.inf, ESCAPE_SLOPE * r)


def plan(
    clearance_map: ClearanceMap,
    start: np.ndarray,
    goal: np.ndarray,
    radius: float,
    *,
    margin: float = 0.0,
    goal_radius: float = 0.0,
    any_angle: bool = True,
    max_expansions: int = 1_000_000,
) -> PlanResult:
    """Shortest way of a disc of ``radius`` from ``start`` to within ``goal_radius`` of ``goal``; metres, world frame.

    Args:
        clearance_map: where the disc's centre has how much room.
        start: ``(2,)`` or planar pose ``(3,)``, of which the position counts.
        goal: ``(2,)``.
        radius: of the body.
        margin: extra clearance everywhere on the path.
        goal_radius: reaching any point so near to the goal is enough; where it is smaller than the grid can tell, the
            path ends at the free node nearest to the goal or, in sight of it, at the goal.
        any_angle: pull the grid path taut; otherwise the path visits cell centres.
        max_expansions: closed nodes after which the search gives up: a count, so that runs repeat exactly.

    Returns:
        Status, path, cost and time; nothing is raised for a start or a goal that cannot be reached.
    """
    began = time.perf_counter()
    c, r = clearance_map.clearance, clearance_map.resolution
    start, goal = np.asarray(start, np.float64)[:2], np.asarray(goal, np.float64)[:2]
    need = needed(clearance_map, start, radius + margin)
    (gx, gy) = (float(v) for v in clearance_map.to_grid(goal))
    disc = max(goal_radius / r, 0.75)  # cells: some node lies so near to any point

    def result(status: PlanStatus, path: np.ndarray, closed: int) -> PlanResult:
        cost = float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) else math.inf
        return PlanResult(status, path, cost, time.perf_counter() - began, closed)

    nothing = np.empty((0, 2))
    if bilinear(c, need.x, need.y) < -ESCAPE_DEPTH:
        return result(PlanStatus.START_BLOCKED, nothing, 0)
    free = _free_cells(c, need)
    if math.hypot(need.x - gx, need.y - gy) <= goal_radius / r:
        return result(PlanStatus.FOUND, start[None], 0)
    if not _goal_free(free, gx, gy, disc):
        return result(PlanStatus.GOAL_BLOCKED, nothing, 0)
    seeds = _seeds(c, r, free, need.x, need.y, need)
    if len(seeds) == 0:
        return result(PlanStatus.START_BLOCKED, nothing, 0)
    code, cells, _, closed = search(free, seeds, gx, gy, disc, max_expansions)
    if code == _NO_PATH:
        return result(PlanStatus.NO_PATH, nothing, closed)
    cells = np.concatenate([[[need.x, need.y]], cells])
    found = code == _FOUND
    if found and goal_radius / r < disc and segment_free(c, r, cells[-1, 0], cells[-1, 1], gx, gy, need):
        cells = np.concatenate([cells, [[gx, gy]]])
    if any_angle:
        # A partial path keeps its end: the disc around it has no size.
        end_x, end_y, rim = (gx, gy, goal_radius / r) if found else (cells[-1, 0], cells[-1, 1], 0.0)
        cells = pull_taut(c, r, cells, end_x, end_y, rim, need)
    return result(PlanStatus.FOUND if found else PlanStatus.TIME_OUT, clearance_map.to_world(cells), closed)
