"""What a grid search is asked, and how its answer becomes a :class:`PlanResult`: the same for every search.

    free cells, seeds, goal's disc  --search-->  nodes  --to the goal, taut-->  path, cost, status

A search runs over the cells of a clearance grid, joined to 16 neighbours (:mod:`vssm_gym.geometry.grid_graph`). The
robot may stand closer to an obstacle than a planner would ever go: what is asked then grows from what it has.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.planning.clearance import Space, bilinear, on_grid
from vssm_gym.planning.grid_search.clearance_requirement import Need, need_at, needed, segment_free
from vssm_gym.planning.grid_search.path_shortening import pull_taut
from vssm_gym.planning.result import PlanResult, PlanStatus

ESCAPE_DEPTH = 0.15  # m inside an obstacle from which a planner still tries to leave; deeper means a lost estimate
NODE_REACH = 0.75  # cells: some node lies so near to any point

FOUND, NO_PATH, TIME_OUT = 0, 1, 2  # what a search says
_STATUS = {FOUND: PlanStatus.FOUND, NO_PATH: PlanStatus.NO_PATH, TIME_OUT: PlanStatus.TIME_OUT}


class Query(NamedTuple):
    """What a search is asked; all in cells but for clearances, which are metres.

    Attributes:
        clearance: ``(nx, ny)`` float32, m.
        resolution: m between cell centres.
        free: ``(nx, ny)`` uint8: cells that have the clearance that is needed.
        seeds: ``(k, 3)`` rows ``i, j, distance`` of the nodes that the start reaches in a straight line.
        goal_x: of the goal.
        goal_y: of the goal.
        goal_radius: the search ends at the first node so near to the goal.
        need: clearance asked for at a place; it holds the start.
        max_expansions: closed nodes after which to give up.
    """

    clearance: np.ndarray
    resolution: float
    free: np.ndarray
    seeds: np.ndarray
    goal_x: float
    goal_y: float
    goal_radius: float
    need: Need
    max_expansions: int


Search = Callable[[Query], tuple[int, np.ndarray, int]]
"""``query -> (code, nodes of the path (n, 2) in cells, closed nodes)``.

After a time-out the path leads to the closed node nearest to the goal.
"""


def answer(
    search: Search,
    start: np.ndarray,
    goal: np.ndarray,
    space: Space,
    radius: float,
    *,
    margin: float,
    goal_radius: float,
    max_expansions: int,
    taut: bool,
) -> PlanResult:
    """Answer a planner's question (:class:`vssm_gym.planning.planners.Planner`) by a grid search.

    ``taut`` pulls the path of nodes taut; otherwise it visits them.
    """
    began = time.perf_counter()
    start, goal = _place(start, "start"), _place(goal, "goal")
    for name, value in (("radius", radius), ("goal_radius", goal_radius), ("margin", margin)):
        if not (math.isfinite(value) and (value >= 0.0 or name == "margin")):
            raise InputError("plan", name, f"a length in metres; found {value!r:.80}")
    clearance_map = on_grid(space)
    c, r = clearance_map.clearance, clearance_map.resolution
    need = needed(clearance_map, start, radius + margin)
    gx, gy = (float(v) for v in clearance_map.to_grid(goal))
    disc = max(goal_radius / r, NODE_REACH)

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
    code, cells, closed = search(Query(c, r, free, seeds, gx, gy, disc, need, max_expansions))
    if code == NO_PATH:
        return result(PlanStatus.NO_PATH, nothing, closed)
    cells = np.concatenate([[[need.x, need.y]], cells])
    found = code == FOUND
    if found and goal_radius / r < disc and segment_free(c, r, cells[-1, 0], cells[-1, 1], gx, gy, need):
        cells = np.concatenate([cells, [[gx, gy]]])
    if taut:
        # A partial path keeps its end: the disc around it has no size.
        end_x, end_y, rim = (gx, gy, goal_radius / r) if found else (cells[-1, 0], cells[-1, 1], 0.0)
        cells = pull_taut(c, r, cells, end_x, end_y, rim, need)
    return result(_STATUS[code], clearance_map.to_world(cells), closed)


def _place(value: np.ndarray, field: str) -> np.ndarray:
    place = np.asarray(value, np.float64)
    if place.shape not in ((2,), (3,)) or not np.isfinite(place).all():
        raise InputError("plan", field, f"two finite coordinates, or a planar pose; found {value!r:.80}")
    return place[:2]


@njit(cache=True, nogil=True)
def _free_cells(clearance, need):
    """Which cells have the clearance that is needed; uint8 ``(nx, ny)``."""
    free = np.empty(clearance.shape, np.uint8)
    for i in range(clearance.shape[0]):
        for j in range(clearance.shape[1]):
            free[i, j] = clearance[i, j] >= need_at(need, i, j)
    return free


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
