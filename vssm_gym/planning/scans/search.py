"""Search for hybrid A* in a table of predicted ranges, compiled: expand nodes by control sequences (eq. P47).

The tree, its nodes and its heap are those of a car's hybrid A* (:mod:`vssm_gym.planning.car.hybrid_search`). What
differs is what an edge is and costs: there are no gears, no curves to the goal and no footprint, and a place is judged
by what a robot would measure there.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.planning.car.hybrid_search import EXHAUSTED, REACHED_GOAL, UNFINISHED, Tree, advance, lower, node_of
from vssm_gym.planning.grid_search.heap import pop
from vssm_gym.planning.scans.control_sequences import Motions
from vssm_gym.planning.scans.range_table import RangeTable


class Edges(NamedTuple):
    """Hold what an edge needs and what it costs."""

    need: float  # m, of the predicted clearance
    floor: float  # m, which a robot that starts with less than it needs must keep while it leaves
    slack: float  # m, by which a range may fall short of a motion that it must allow
    danger: float  # a metre, extra, for a danger of 1
    turn: float  # m, of a radian
    escape: float  # a metre, extra, with less clearance than needed


@njit(cache=True, nogil=True)
def _corner(table, x, y):
    """Return the numbers of the lower corner of a place, and its shares of the way to the next; -1: outside."""
    nx, ny = table.clearance.shape
    u, v = (x - table.x) / table.spacing, (y - table.y) / table.spacing
    if not (0.0 <= u <= nx - 1 and 0.0 <= v <= ny - 1):
        return -1, -1, 0.0, 0.0
    i, j = min(math.floor(u), nx - 2), min(math.floor(v), ny - 2)
    return i, j, u - i, v - j


@njit(cache=True, nogil=True)
def _blend(values, i, j, u, v):
    """Return the bilinear value."""
    below = (1.0 - u) * values[i, j] + u * values[i + 1, j]
    return (1.0 - v) * below + v * ((1.0 - u) * values[i, j + 1] + u * values[i + 1, j + 1])


@njit(cache=True, nogil=True)
def clearance_at(table: RangeTable, x: float, y: float) -> float:
    """Return the predicted clearance, m; -1 beyond the table."""
    i, j, u, v = _corner(table, x, y)
    return _blend(table.clearance, i, j, u, v) if i >= 0 else -1.0


@njit(cache=True, nogil=True)
def sees(table: RangeTable, x: float, y: float, to_x: float, to_y: float, needed: float) -> bool:
    """Return True if the range predicted at a place towards another reaches ``needed`` m."""
    i, j, u, v = _corner(table, x, y)
    if i < 0:
        return False
    n = table.reach.shape[2]
    k = math.floor(math.atan2(to_y - y, to_x - x) * n / (2.0 * math.pi) + 0.5) % n
    return _blend(table.reach[:, :, k], i, j, u, v) >= needed


@njit(cache=True, nogil=True)
def _expand(tree, table, motions, edges, goal, radius, node):
    """Open the ends of every feasible motion from ``node`` that are reached more cheaply than before."""
    pose = tree.pose[node]
    for m in range(motions.displacement.shape[0]):
        x, y, heading = advance(pose, motions.displacement[m, -1])
        other = node_of(tree, x, y, heading)
        if other < 0 or other == node or tree.place[other] == -2:
            continue
        cost = tree.cost[node] + edges.turn * motions.turned[m]
        escape, feasible = tree.escape[node], True
        at_x, at_y = pose[0], pose[1]
        for part in range(motions.displacement.shape[1]):
            length = motions.length[m, part]
            if length < 1e-9:
                continue
            to_x, to_y, _ = advance(pose, motions.displacement[m, part])
            i, j, u, v = _corner(table, to_x, to_y)
            if i < 0:
                feasible = False
                break
            clearance = _blend(table.clearance, i, j, u, v)
            cost += length * (1.0 + edges.danger * _blend(table.danger, i, j, u, v))
            if clearance < edges.need:
                escape -= length
                cost += edges.escape * length
                if escape <= 0.0 or clearance < edges.floor:
                    feasible = False
                    break
            else:
                # A model may predict free space behind a wall where nobody was: the wall is seen from before it
                if escape == 0.0 and not sees(table, at_x, at_y, to_x, to_y, length + edges.need - edges.slack):
                    feasible = False
                    break
                escape = 0.0
            if cost >= tree.cost[other]:
                feasible = False
                break
            at_x, at_y = to_x, to_y
        if not feasible or cost >= tree.cost[other]:
            continue
        tree.parent[other], tree.move[other], tree.escape[other] = node, m, escape
        tree.pose[other, 0], tree.pose[other, 1], tree.pose[other, 2] = x, y, heading
        tree.ahead[other] = max(0.0, math.hypot(goal[0] - x, goal[1] - y) - radius)
        lower(tree, other, cost, cost + tree.ahead[other])


@njit(cache=True, nogil=True)
def open_at(tree: Tree, start: np.ndarray, goal: np.ndarray, escape: float) -> bool:
    """Put the start into the heap; return False where it lies beyond the grid."""
    node = node_of(tree, start[0], start[1], start[2])
    if node < 0:
        return False
    ahead = math.hypot(goal[0] - start[0], goal[1] - start[1])
    tree.pose[node], tree.escape[node], tree.ahead[node] = start, escape, ahead
    tree.counts[2] = node
    lower(tree, node, 0.0, ahead)
    return True


@njit(cache=True, nogil=True)
def search(
    tree: Tree, table: RangeTable, motions: Motions, edges: Edges, goal: np.ndarray, radius: float, budget: int
) -> int:
    """Close up to ``budget`` nodes, until one lies within ``radius`` of the goal.

    ``tree.counts[2]`` is the closed node nearest to the goal.
    """
    for _ in range(budget):
        if tree.counts[0] == 0:
            return EXHAUSTED
        node = pop(tree.heap, tree.place, tree.key, tree.counts[0])
        tree.counts[0] -= 1
        tree.place[node] = -2
        tree.counts[1] += 1
        if tree.ahead[node] < tree.ahead[tree.counts[2]]:
            tree.counts[2] = node
        if math.hypot(goal[0] - tree.pose[node, 0], goal[1] - tree.pose[node, 1]) <= radius:
            tree.counts[2] = node
            return REACHED_GOAL
        _expand(tree, table, motions, edges, goal, radius, node)
    return UNFINISHED
