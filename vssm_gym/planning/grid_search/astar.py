"""Plan by A* over a uniform 2D grid: ``min sum w |edges|`` to the goal's region, then shortened (eq. P3, P5).

The planner of TNP-SM. Nodes are the cells of a clearance grid, each joined to 16 neighbours. All of an edge's segment
must be free. The cost of an edge is its length times its weight (1 where the space has none, never less), and the
heuristic is the Euclidean distance to the goal's disc.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.geometry.grid_graph import LENGTHS, MOVES, edge_free
from vssm_gym.planning.clearance import Space
from vssm_gym.planning.grid_search.heap import pop, sift_up
from vssm_gym.planning.grid_search.query import FOUND, NO_PATH, TIME_OUT, Query, plan_by_search
from vssm_gym.planning.result import PlanResult


@njit(cache=True, nogil=True)
def search(
    free: np.ndarray,
    weight: np.ndarray,
    seeds: np.ndarray,
    gx: float,
    gy: float,
    radius: float,
    max_expansions: int,
) -> tuple[int, np.ndarray, float, int]:
    """Search by A* from ``seeds`` (rows ``i, j, cost so far``) to the first node within ``radius`` of ``(gx, gy)``.

    All in cells. An edge costs its length times the mean weight of its ends.

    Returns:
        Code, nodes of the path ``(n, 2)``, its cost in cells, closed nodes. After a time-out the path leads to the
        closed node with the least heuristic.
    """
    nx, ny = free.shape
    weighted = weight.shape[0] > 0
    cost, key, parent, place, heap, size = opened(nx, ny, seeds, gx, gy, radius)
    closed, nearest, least, code = 0, -1, np.inf, NO_PATH
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
            code = FOUND
            break
        if closed >= max_expansions:
            code = TIME_OUT
            break
        for m in range(MOVES.shape[0]):
            di, dj = MOVES[m, 0], MOVES[m, 1]
            if not (0 <= i + di < nx and 0 <= j + dj < ny):
                continue
            other = (i + di) * ny + j + dj
            length = LENGTHS[m]
            if weighted:
                length *= 0.5 * (weight[i, j] + weight[i + di, j + dj])
            through = cost[node] + length
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
    if code == NO_PATH:
        return code, np.empty((0, 2)), np.inf, closed
    return code, path_to(nearest, parent, ny), cost[nearest], closed


@njit(cache=True, nogil=True)
def opened(
    nx: int, ny: int, seeds: np.ndarray, gx: float, gy: float, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Return the arrays of a search over ``nx * ny`` nodes, the seeds open: costs, keys, parents, places, heap, size.

    The key of a node is its cost plus its distance to the disc of ``radius`` around ``(gx, gy)``; all in cells.
    """
    cost = np.full(nx * ny, np.inf)
    key = np.empty(nx * ny)
    parent = np.full(nx * ny, -1, np.int32)
    place = np.full(nx * ny, -1, np.int32)
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
    return cost, key, parent, place, heap, size


@njit(cache=True, nogil=True)
def path_to(node: int, parent: np.ndarray, ny: int) -> np.ndarray:
    """Return the cells ``(n, 2)`` from the search's root to ``node``, which follow from the parents of the nodes."""
    count, last = 0, node
    while node >= 0:
        count, node = count + 1, parent[node]
    path, node = np.empty((count, 2)), last
    for k in range(count - 1, -1, -1):
        path[k, 0], path[k, 1] = node // ny, node % ny
        node = parent[node]
    return path


def plan(
    start: np.ndarray,
    goal: np.ndarray,
    space: Space,
    radius: float,
    *,
    margin: float = 0.0,
    goal_radius: float = 0.0,
    max_expansions: int = 1_000_000,
    any_angle: bool = True,
) -> PlanResult:
    """Plan as :class:`vssm_gym.planning.planners.Planner`; without ``any_angle`` the path visits cell centres."""
    return plan_by_search(
        _search,
        start,
        goal,
        space,
        radius,
        margin=margin,
        goal_radius=goal_radius,
        max_expansions=max_expansions,
        shorten=any_angle,
    )


def _search(q: Query) -> tuple[int, np.ndarray, int]:
    code, cells, _, closed = search(q.free, q.weight, q.seeds, q.goal_x, q.goal_y, q.goal_radius, q.max_expansions)
    return code, cells, closed
