"""Plan by Theta*: A* over the grid, in which the parent of a node is any node, or the start, that sees it (eq. P4).

    g(s') = g(p) + w |s' - p|   where p, the parent of s, sees s';   or g(s) + w |s' - s| if that is less

The path therefore bends at obstacles only and needs no shortening afterwards (Nash, Daniel, Koenig and Felner, "Theta*:
any-angle path planning on grids", AAAI 2007). It visits nodes, so each bend is up to about a cell away from the corner.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.geometry.grid_graph import MOVES, edge_free
from vssm_gym.planning.clearance import Space
from vssm_gym.planning.grid_search.astar import opened, path_to
from vssm_gym.planning.grid_search.clearance_requirement import ClearanceRequirement, segment_free
from vssm_gym.planning.grid_search.heap import pop, sift_up
from vssm_gym.planning.grid_search.path_cost import segment_cost
from vssm_gym.planning.grid_search.query import FOUND, NO_PATH, TIME_OUT, plan_by_search
from vssm_gym.planning.result import PlanResult


def plan(
    start: np.ndarray,
    goal: np.ndarray,
    space: Space,
    radius: float,
    *,
    margin: float = 0.0,
    goal_radius: float = 0.0,
    max_expansions: int = 1_000_000,
) -> PlanResult:
    """Plan as :class:`vssm_gym.planning.planners.Planner`.

    The path visits nodes of the grid.
    """
    return plan_by_search(
        lambda query: search(*query),
        start,
        goal,
        space,
        radius,
        margin=margin,
        goal_radius=goal_radius,
        max_expansions=max_expansions,
        shorten=False,
    )


@njit(cache=True, nogil=True)
def search(
    clearance: np.ndarray,
    weight: np.ndarray,
    resolution: float,
    free: np.ndarray,
    seeds: np.ndarray,
    gx: float,
    gy: float,
    radius: float,
    required: ClearanceRequirement,
    max_expansions: int,
) -> tuple[int, np.ndarray, int]:
    """Search by Theta* for the first node within ``radius`` of the goal; see ``query.Query`` and ``query.Search``."""
    nx, ny = free.shape
    cost, key, parent, place, heap, size = opened(nx, ny, seeds, gx, gy, radius)  # a parent of -1 is the start
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
        p = parent[node]
        px, py, so_far = (float(p // ny), float(p % ny), cost[p]) if p >= 0 else (required.x, required.y, 0.0)
        for m in range(MOVES.shape[0]):
            di, dj = MOVES[m, 0], MOVES[m, 1]
            if not (0 <= i + di < nx and 0 <= j + dj < ny):
                continue
            other = (i + di) * ny + j + dj
            x, y = float(i + di), float(j + dj)
            through, before = so_far + segment_cost(weight, px, py, x, y), p
            edge = cost[node] + segment_cost(weight, float(i), float(j), x, y)
            # Without a weight the line from the parent is never the longer one, by the triangle inequality.
            if min(through, edge) >= cost[other] or place[other] == -2 or not edge_free(free, i, j, di, dj):
                continue
            if edge < through or not segment_free(clearance, resolution, px, py, x, y, required):
                through, before = edge, node
                if through >= cost[other]:
                    continue
            cost[other], parent[other] = through, before
            key[other] = through + max(0.0, math.hypot(x - gx, y - gy) - radius)
            if place[other] == -1:
                heap[size], place[other] = other, size
                size += 1
            sift_up(heap, place, key, place[other])
    if code == NO_PATH:
        return code, np.empty((0, 2)), closed
    return code, path_to(nearest, parent, ny), closed
