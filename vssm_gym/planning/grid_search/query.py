"""Turn a planner's arguments into a grid search, and the search's nodes into a :class:`PlanResult`.

    free cells, seeds, goal's disc  --search-->  nodes  --goal, shortening-->  path, cost, status

All grid searches share these steps. A search runs over the cells of a clearance grid, joined to 16 neighbours
(:mod:`vssm_gym.geometry.grid_graph`). The robot may stand closer to an obstacle than a planner would ever go: the
required clearance then grows from the clearance at the start.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.planning.clearance import Space, bilinear, on_grid
from vssm_gym.planning.grid_search.clearance_requirement import (
    ClearanceRequirement,
    required_at,
    requirement_from,
    segment_free,
)
from vssm_gym.planning.grid_search.path_cost import path_cost, segment_cost
from vssm_gym.planning.grid_search.path_shortening import shorten_cells
from vssm_gym.planning.result import PlanResult, PlanStatus

ESCAPE_DEPTH = 0.15  # m inside an obstacle from which a planner still leaves; a pose estimate that is deeper is lost
NODE_REACH = 0.75  # cells; every point has a node within sqrt(1/2) = 0.71 cells

FOUND, NO_PATH, TIME_OUT = 0, 1, 2  # a search's result codes
_STATUS = {FOUND: PlanStatus.FOUND, NO_PATH: PlanStatus.NO_PATH, TIME_OUT: PlanStatus.TIME_OUT}


class Query(NamedTuple):
    """Hold the arguments of a search; lengths are in cells, clearances in metres.

    Attributes:
        clearance: ``(nx, ny)`` float32, m.
        weight: ``(nx, ny)`` float32, cost a metre, or ``UNIFORM``.
        resolution: m between cell centres.
        free: ``(nx, ny)`` uint8: cells that have the required clearance.
        seeds: ``(k, 3)`` rows ``i, j, cost`` of the nodes that the start reaches in a straight line.
        goal_x: of the goal.
        goal_y: of the goal.
        goal_radius: the search ends at the first node so near to the goal.
        required: clearance required at each place; it holds the start.
        max_expansions: closed nodes after which to give up.
    """

    clearance: np.ndarray
    weight: np.ndarray
    resolution: float
    free: np.ndarray
    seeds: np.ndarray
    goal_x: float
    goal_y: float
    goal_radius: float
    required: ClearanceRequirement
    max_expansions: int


Search = Callable[[Query], tuple[int, np.ndarray, int]]
"""``query -> (code, nodes of the path (n, 2) in cells, closed nodes)``.

After a time-out the path leads to the closed node nearest to the goal.
"""


def plan_by_search(
    search: Search,
    start: np.ndarray,
    goal: np.ndarray,
    space: Space,
    radius: float,
    *,
    margin: float,
    goal_radius: float,
    max_expansions: int,
    shorten: bool,
) -> PlanResult:
    """Plan as :class:`vssm_gym.planning.planners.Planner` by a grid search.

    With ``shorten`` the path of nodes is shortened to an any-angle path; without, it visits the nodes.
    """
    began = time.perf_counter()
    start, goal = _place(start, "start"), _place(goal, "goal")
    for name, value in (("radius", radius), ("goal_radius", goal_radius), ("margin", margin)):
        if not (math.isfinite(value) and (value >= 0.0 or name == "margin")):
            raise InputError("plan", name, f"a length in metres; found {value!r:.80}")
    clearance_map = on_grid(space)
    c, w, r = clearance_map.clearance, clearance_map.weights, clearance_map.resolution
    required = requirement_from(clearance_map, start, radius + margin)
    gx, gy = (float(v) for v in clearance_map.to_grid(goal))
    disc = max(goal_radius / r, NODE_REACH)

    def result(status: PlanStatus, path: np.ndarray, closed: int) -> PlanResult:
        cost = r * path_cost(w, clearance_map.to_grid(path)) if len(path) else math.inf
        return PlanResult(status, path, cost, time.perf_counter() - began, closed)

    nothing = np.empty((0, 2))
    if bilinear(c, required.x, required.y) < -ESCAPE_DEPTH:
        return result(PlanStatus.START_BLOCKED, nothing, 0)
    free = _free_cells(c, required)
    if math.hypot(required.x - gx, required.y - gy) <= goal_radius / r:
        return result(PlanStatus.FOUND, start[None], 0)
    if not _goal_free(free, gx, gy, disc):
        return result(PlanStatus.GOAL_BLOCKED, nothing, 0)
    seeds = _seeds(c, w, r, free, required.x, required.y, required)
    if len(seeds) == 0:
        return result(PlanStatus.START_BLOCKED, nothing, 0)
    code, cells, closed = search(Query(c, w, r, free, seeds, gx, gy, disc, required, max_expansions))
    if code == NO_PATH:
        return result(PlanStatus.NO_PATH, nothing, closed)
    cells = np.concatenate([[[required.x, required.y]], cells])
    found = code == FOUND
    if found and goal_radius / r < disc and segment_free(c, r, cells[-1, 0], cells[-1, 1], gx, gy, required):
        cells = np.concatenate([cells, [[gx, gy]]])
    if shorten:
        # A partial path keeps its end: the disc around it has no size.
        end_x, end_y, rim = (gx, gy, goal_radius / r) if found else (cells[-1, 0], cells[-1, 1], 0.0)
        cells = shorten_cells(c, w, r, cells, end_x, end_y, rim, required)
    return result(_STATUS[code], clearance_map.to_world(cells), closed)


def _place(value: np.ndarray, field: str) -> np.ndarray:
    place = np.asarray(value, np.float64)
    if place.shape not in ((2,), (3,)) or not np.isfinite(place).all():
        raise InputError("plan", field, f"two finite coordinates, or a planar pose; found {value!r:.80}")
    return place[:2]


@njit(cache=True, nogil=True)
def _free_cells(clearance, required):
    """Mark the cells that have the required clearance; uint8 ``(nx, ny)``."""
    free = np.empty(clearance.shape, np.uint8)
    for i in range(clearance.shape[0]):
        for j in range(clearance.shape[1]):
            free[i, j] = clearance[i, j] >= required_at(required, i, j)
    return free


@njit(cache=True, nogil=True)
def _seeds(clearance, weight, resolution, free, x, y, required):
    """Return the corners of the start's cell that it reaches in a straight line: rows ``i, j, cost``."""
    rows = np.empty((4, 3))
    count = 0
    for k in range(4):
        i, j = math.floor(x) + (k & 1), math.floor(y) + (k >> 1)
        if not (0 <= i < free.shape[0] and 0 <= j < free.shape[1]) or not free[i, j]:
            continue
        if segment_free(clearance, resolution, x, y, float(i), float(j), required):
            rows[count, 0], rows[count, 1], rows[count, 2] = i, j, segment_cost(weight, x, y, float(i), float(j))
            count += 1
    return rows[:count]


@njit(cache=True, nogil=True)
def _goal_free(free, gx, gy, radius):
    for i in range(max(0, int(gx - radius)), min(free.shape[0], int(gx + radius) + 2)):
        for j in range(max(0, int(gy - radius)), min(free.shape[1], int(gy + radius) + 2)):
            if free[i, j] and math.hypot(i - gx, j - gy) <= radius:
                return True
    return False
