"""Search for hybrid A*, compiled: expand nodes by arcs, and shoot Reeds-Shepp curves at the goal (eq. P13).

A node is a cell of ``(x, y, heading)`` and keeps the one continuous pose that reached it most cheaply. Costs are in
metres: ``|l| (1 + reverse [l < 0] + c)`` for a segment of length ``l``, ``c`` the extra cost a metre near obstacles,
plus ``cusp`` where the gear changes and ``steer |s - s'|`` where the steering does, ``s`` in shares of the full lock.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from vssm_gym.geometry.arc import pose_after
from vssm_gym.planning.car.footprint_levels import COLLIDING, TIGHT, Lookup, level_at
from vssm_gym.planning.car.reeds_shepp import SOLUTIONS, relative, shortest, words
from vssm_gym.planning.grid_search.heap import pop, sift_up

# Results of `search`: its budget is used up, the goal is reached, nothing is left.
UNFINISHED, REACHED_GOAL, EXHAUSTED = 0, 1, 2
SHOT_SPACING = 0.25  # m of remaining distance per which one more node is expanded between two shots


class Costs(NamedTuple):
    """Hold the weights of a drive's costs besides its length."""

    reverse: float = 0.2  # a metre, extra
    cusp: float = 0.3  # m, of stopping to change gear
    steer: float = 0.05  # m, of turning the wheels from straight to full lock
    tight: float = 1.0  # a metre, extra, where the margin of comfort is not kept
    collision: float = 10.0  # a metre, extra, while a start in collision leaves it


class Moves(NamedTuple):
    """Hold the arcs that leave a node; ``k`` of them in ``m`` parts each."""

    displacement: np.ndarray  # (k, m, 3) forward, left (m), turn (rad) from the node to the end of each part
    gear: np.ndarray  # (k,) 1.0 or -1.0
    steering: np.ndarray  # (k,) share of the full lock, left positive
    step: float  # m, length of each


class Goal(NamedTuple):
    """Hold the goal: ``poses``, any of which will do, and a lower bound of the path length to it."""

    poses: np.ndarray  # (g, 3)
    distance: np.ndarray  # (nx, ny) m around obstacles, on the cells of the lookup


class Tree(NamedTuple):
    """Hold the nodes by number ``(ix * ny + iy) * n_headings + k``; the last is the goal, after a curve."""

    shape: tuple[int, int, int]
    cell: float  # m
    x: float  # m, of the lowest corner
    y: float
    cost: np.ndarray
    key: np.ndarray  # cost and what at least is still to come
    ahead: np.ndarray  # the latter alone; nan before it is known
    escape: np.ndarray  # m that may still be driven in collision
    parent: np.ndarray
    move: np.ndarray  # the arc from the parent; -1 at the start
    place: np.ndarray
    pose: np.ndarray
    heap: np.ndarray
    counts: np.ndarray  # size of the heap, closed nodes, the closed node with the least still to come, shots so far
    curve: np.ndarray  # (5, 2) lengths (m) and steerings of the curve to the goal


def empty_tree(low: Float[np.ndarray, "2"], extent: Float[np.ndarray, "2"], cell: float, headings: int) -> Tree:
    """Return a tree without nodes over a rectangle of the plane.

    Args:
        low: its lowest corner, m.
        extent: along x and y, m.
        cell: of the search, m.
        headings: of the search.
    """
    nx, ny = (math.ceil(e / cell - 1e-9) for e in extent)
    n = nx * ny * headings + 1
    ahead = np.full(n, np.nan)
    return Tree(
        *((nx, ny, headings), float(cell), float(low[0]), float(low[1])),
        *(np.full(n, np.inf), np.empty(n), ahead, np.zeros(n)),
        *(np.full(n, -1, np.int32), np.full(n, -1, np.int16), np.full(n, -1, np.int32)),
        *(np.empty((n, 3)), np.empty(n, np.int32), np.zeros(4, np.int64), np.zeros((5, 2))),
    )


@njit(cache=True, nogil=True)
def node_of(tree: Tree, x: float, y: float, heading: float) -> int:
    """Return the number of the cell of a pose; -1 beyond the grid."""
    nx, ny, nh = tree.shape
    i, j = math.floor((x - tree.x) / tree.cell), math.floor((y - tree.y) / tree.cell)
    if not (0 <= i < nx and 0 <= j < ny):
        return -1
    return (i * ny + j) * nh + math.floor(heading * nh / (2.0 * math.pi) + 0.5) % nh


@njit(cache=True, nogil=True)
def _still_to_come(lookup, goal, radius, x, y, heading):
    """Return the larger path length, m: around obstacles for a point, or without obstacles for a car."""
    nx, ny = goal.distance.shape
    i = math.floor((x - lookup.x) / lookup.resolution + 0.5)
    j = math.floor((y - lookup.y) / lookup.resolution + 0.5)
    if not (0 <= i < nx and 0 <= j < ny):
        return np.inf
    bound = max(0.0, goal.distance[i, j] - lookup.resolution)  # the pose is not in the middle of its cell
    if goal.poses.shape[0] == 1:
        g = goal.poses[0]
        bound = max(bound, radius * shortest(*relative(x, y, heading, g[0], g[1], g[2], radius)))
    return bound


@njit(cache=True, nogil=True)
def advance(pose: np.ndarray, d: np.ndarray) -> tuple[float, float, float]:
    """Return the pose after a displacement ``d`` (forward, left, turn) in its own frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + c * d[0] - s * d[1], pose[1] + s * d[0] + c * d[1], pose[2] + d[2]


@njit(cache=True, nogil=True)
def word_cost(lengths: np.ndarray, steerings: np.ndarray, gear: float, steering: float, costs: Costs) -> float:
    """Return the cost in free space of segments ``(5,)`` (m) after driving in ``gear`` (0: rest) with ``steering``."""
    total = 0.0
    for i in range(lengths.shape[0]):
        if abs(lengths[i]) < 1e-9:
            continue
        sign = 1.0 if lengths[i] > 0.0 else -1.0
        total += abs(lengths[i]) * (1.0 if sign > 0.0 else 1.0 + costs.reverse)
        total += costs.cusp if sign * gear < 0.0 else 0.0
        total += costs.steer * abs(steerings[i] - steering)
        gear, steering = sign, float(steerings[i])
    return total


@njit(cache=True, nogil=True)
def curve_excess(
    lookup: Lookup, pose: np.ndarray, lengths: np.ndarray, steerings: np.ndarray, radius: float, tight: float
) -> float:
    """Return the extra cost of segments (m) from ``pose`` near obstacles; infinite where the car would collide."""
    x, y, heading = pose[0], pose[1], pose[2]
    excess = 0.0
    for i in range(lengths.shape[0]):
        parts = math.ceil(abs(lengths[i]) / lookup.resolution)
        for _ in range(parts):
            s = lengths[i] / parts
            turn = steerings[i] * s / radius
            x, y, heading = pose_after(x, y, heading, s * (1.0 - turn * turn / 24.0), turn)  # of an arc of one cell
            level = level_at(lookup, x, y, heading)
            if level == COLLIDING:
                return np.inf
            if level == TIGHT:
                excess += tight * abs(s)
    return excess


@njit(cache=True, nogil=True)
def cheapest_curve(
    lookup: Lookup,
    pose: np.ndarray,
    end: np.ndarray,
    radius: float,
    gear: float,
    steering: float,
    costs: Costs,
    bound: float,
    best: np.ndarray,
) -> float:
    """Return the cost of the cheapest free curve, written to ``best`` ``(5, 2)``; ``bound`` where none is cheaper."""
    lengths, steerings = np.empty((SOLUTIONS, 5)), np.empty((SOLUTIONS, 5), np.int8)
    x, y, a = relative(pose[0], pose[1], pose[2], end[0], end[1], end[2], radius)
    count = words(x, y, a, lengths, steerings)
    price = np.empty(count)
    for k in range(count):
        for i in range(5):
            lengths[k, i] *= radius
        price[k] = word_cost(lengths[k], steerings[k], gear, steering, costs)
    for k in np.argsort(price):
        if price[k] >= bound:
            break
        total = price[k] + curve_excess(lookup, pose, lengths[k], steerings[k], radius, costs.tight)
        if total < bound:
            bound = total
            best[:, 0], best[:, 1] = lengths[k], steerings[k]
    return bound


@njit(cache=True, nogil=True)
def lower(tree, node, cost, key):
    """Lower the cost and the key of a node, and enter it into the heap, or move it up there."""
    tree.cost[node], tree.key[node] = cost, key
    if tree.place[node] == -1:
        tree.place[node] = tree.counts[0]
        tree.heap[tree.counts[0]] = node
        tree.counts[0] += 1
    sift_up(tree.heap, tree.place, tree.key, tree.place[node])


@njit(cache=True, nogil=True)
def _shoot(tree, lookup, goal, moves, radius, costs, node):
    """Try to end the plan by a curve from ``node``; the goal's node keeps the cheapest."""
    last = tree.cost.shape[0] - 1
    m = tree.move[node]
    gear, steering = (moves.gear[m], moves.steering[m]) if m >= 0 else (0.0, 0.0)
    for k in range(goal.poses.shape[0]):
        bound = tree.cost[last] - tree.cost[node]
        total = cheapest_curve(lookup, tree.pose[node], goal.poses[k], radius, gear, steering, costs, bound, tree.curve)
        if total < bound:
            tree.parent[last] = node
            tree.pose[last] = goal.poses[k]
            lower(tree, last, tree.cost[node] + total, tree.cost[node] + total)


@njit(cache=True, nogil=True)
def open_start(tree: Tree, lookup: Lookup, goal: Goal, radius: float, start: np.ndarray, escape: float) -> bool:
    """Put the start into the heap; return False where no path leads to the goal even for a point."""
    node = node_of(tree, start[0], start[1], start[2])
    ahead = _still_to_come(lookup, goal, radius, start[0], start[1], start[2])
    if node < 0 or ahead == np.inf:
        return False
    tree.pose[node], tree.escape[node], tree.ahead[node] = start, escape, ahead
    tree.counts[2] = node
    lower(tree, node, 0.0, ahead)
    return True


@njit(cache=True, nogil=True)
def _expand(tree, lookup, goal, moves, radius, costs, node):
    """Open the ends of every free arc from ``node`` that are reached more cheaply than before."""
    pose, before = tree.pose[node], tree.move[node]
    for m in range(moves.gear.shape[0]):
        x, y, heading = advance(pose, moves.displacement[m, -1])
        other = node_of(tree, x, y, heading)
        if other < 0 or other == node or tree.place[other] == -2:
            continue
        cost = tree.cost[node] + moves.step * (1.0 if moves.gear[m] > 0.0 else 1.0 + costs.reverse)
        if before >= 0:
            cost += costs.cusp if moves.gear[m] != moves.gear[before] else 0.0
            cost += costs.steer * abs(moves.steering[m] - moves.steering[before])
        if cost >= tree.cost[other]:
            continue
        escape, part, level = tree.escape[node], moves.step / moves.displacement.shape[1], 0
        for i in range(moves.displacement.shape[1]):
            level = level_at(lookup, *advance(pose, moves.displacement[m, i]))
            if level == COLLIDING:
                escape -= part
                if escape <= 0.0:
                    break
                cost += costs.collision * part
            else:
                escape = 0.0  # out: from here on collisions end the arc
                cost += costs.tight * part if level == TIGHT else 0.0
        if (level == COLLIDING and escape <= 0.0) or cost >= tree.cost[other]:
            continue
        if np.isnan(tree.ahead[other]):
            tree.ahead[other] = _still_to_come(lookup, goal, radius, x, y, heading)
        if tree.ahead[other] == np.inf:
            continue
        tree.parent[other], tree.move[other], tree.escape[other] = node, m, escape
        tree.pose[other, 0], tree.pose[other, 1], tree.pose[other, 2] = x, y, heading
        lower(tree, other, cost, cost + tree.ahead[other])


@njit(cache=True, nogil=True)
def search(tree: Tree, lookup: Lookup, goal: Goal, moves: Moves, radius: float, costs: Costs, budget: int) -> int:
    """Close up to ``budget`` nodes; call again to continue. Curves are shot the more often the nearer the goal is:
    from one of ``n + 1`` nodes between ``n`` and ``n + 1`` times :data:`SHOT_SPACING` from it.
    """
    last = tree.cost.shape[0] - 1
    for _ in range(budget):
        if tree.counts[0] == 0:
            return EXHAUSTED
        node = pop(tree.heap, tree.place, tree.key, tree.counts[0])
        tree.counts[0] -= 1
        tree.place[node] = -2
        if node == last:
            return REACHED_GOAL
        tree.counts[1] += 1
        if tree.ahead[node] < tree.ahead[tree.counts[2]]:
            tree.counts[2] = node
        tree.counts[3] += 1
        if tree.counts[3] > tree.ahead[node] / SHOT_SPACING:
            tree.counts[3] = 0
            if tree.escape[node] == 0.0:
                _shoot(tree, lookup, goal, moves, radius, costs, node)
        _expand(tree, lookup, goal, moves, radius, costs, node)
    return UNFINISHED
