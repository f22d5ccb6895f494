"""Plan by Hybrid A*: a cheap drive of a car between two poses, forwards and backwards, around obstacles (eq. P13).

    min sum |l_i| (1 + reverse [l_i < 0] + tight [near]) + cusp (gear changes) + steer sum |s_i - s_i-1|

over chains of arcs, ended by a Reeds-Shepp curve (Dolgov, Thrun, Montemerlo and Diebel, "Path planning for autonomous
vehicles in unknown semi-structured environments", IJRR 29, 2010). A cell of (x, y, heading) keeps one continuous pose,
so the plan can be driven exactly; what is lost is a guarantee of the optimum. The heuristic is the larger of the
Reeds-Shepp length without obstacles and the path around obstacles for a point. At the end curves replace pieces of the
plan wherever that is cheaper.
"""

import math
import time
from dataclasses import dataclass, field

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.arc import poses_after
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car import hybrid_search, reeds_shepp
from vssm_gym.planning.car.footprint_levels import COLLIDING, FootprintLevels
from vssm_gym.planning.car.hybrid_search import Costs, Goal, Moves, Tree
from vssm_gym.planning.car.shortcuts import shortcut
from vssm_gym.planning.grid_search.goal_distance import goal_distance
from vssm_gym.planning.result import PlanStatus

_NODES_AT_ONCE = 200  # nodes between two readings of the clock


@dataclass(frozen=True)
class HybridAStarConfig:
    """Configure the costs and the resolution of the search.

    Args:
        costs: weights relative to the length.
        cell: of the search, m; arcs are one and a half as long. Halved where the search finds no path.
        headings: of the search; doubled there.
        steerings: of the arcs, from full lock to full lock, odd.
        full_lock: share of the steering that plans use; the rest corrects errors while following them.
        escape_length: distance that a start in collision may drive to come free, m.
        arrivals: headings tried at a goal that is only a point.
    """

    costs: Costs = field(default_factory=Costs)
    cell: float = 0.1
    headings: int = 72
    steerings: int = 5
    full_lock: float = 0.9
    escape_length: float = 0.25
    arrivals: int = 24

    def __post_init__(self) -> None:
        if self.steerings < 3 or self.steerings % 2 == 0:
            expected = f"an odd number from 3 on; found {self.steerings!r:.80}"
            raise InputError("HybridAStarConfig", "steerings", expected)

    def radius(self, car: Car) -> float:
        """Return the turning radius of the tightest arcs, m."""
        return car.wheelbase / math.tan(self.full_lock * car.max_steering)


@dataclass(frozen=True)
class CarPlan:
    """Hold a drive from the start to the goal, or the reason why there is none.

    It has the fields of a :class:`~vssm_gym.planning.result.PlanResult`, and headings and gears.

    Attributes:
        status: how the search ended.
        poses: ``(n, 3)`` x, y (m), heading (rad, in [-pi, pi)) at most a cell of the collision table apart, the start
            first; empty ``(0, 3)`` where there is no plan, the best partial one after a time-out.
        gears: ``(n,)`` int8, 1 forwards, -1 backwards up to the pose; the first is the second's.
        cost: length driven, m; infinite where there is no plan.
        seconds: wall-clock time of the whole call.
        expansions: nodes that the search closed.
    """

    status: PlanStatus
    poses: np.ndarray
    gears: np.ndarray
    cost: float
    seconds: float
    expansions: int

    @property
    def found(self) -> bool:
        """Return True where the plan ends at the goal."""
        return self.status is PlanStatus.FOUND

    @property
    def path(self) -> np.ndarray:
        """Return the ``(n, 2)`` positions of the rear axle, m."""
        return self.poses[:, :2]

    @property
    def cusps(self) -> int:
        """Return how often the car changes its gear."""
        return int(np.count_nonzero(np.diff(self.gears)))


def plan(
    start: np.ndarray,
    goal: np.ndarray,
    obstacles: FootprintLevels,
    car: Car,
    *,
    config: HybridAStarConfig | None = None,
    time_limit: float = 5.0,
    max_expansions: int = 1_000_000,
) -> CarPlan:
    """Plan a cheap drive of ``car`` from the pose ``start`` to ``goal``.

    Args:
        start: ``(3,)`` x, y (m), heading (rad).
        goal: a pose ``(3,)``, or a point ``(2,)``.
        obstacles: levels of the footprint's poses.
        car: its measures.
        config: costs and resolution of the search.
        time_limit: s of searching, after which the best plan so far is returned: it then depends on the machine.
        max_expansions: closed nodes after which the search gives up: a count, so that runs repeat exactly.

    Returns:
        Status, poses and gears; nothing is raised for a start or a goal that cannot be reached.
    """
    began = time.perf_counter()
    start, goal = _pose(start, (3,), "start"), _pose(goal, (2, 3), "goal")
    config = config or HybridAStarConfig()
    costs, radius = config.costs, config.radius(car)

    def result(status: PlanStatus, poses: np.ndarray, gears: np.ndarray, closed: int) -> CarPlan:
        poses[:, 2] = wrap_angle(poses[:, 2])
        chord = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        # of arcs, not of chords: sinc(turn / 2) is the ratio of the two
        driven = float((chord / np.sinc(wrap_angle(np.diff(poses[:, 2])) / (2.0 * np.pi))).sum())
        length = driven if len(poses) else math.inf
        return CarPlan(status, poses, gears, length, time.perf_counter() - began, closed)

    nothing = np.empty((0, 3)), np.empty(0, np.int8)
    arrivals = _arrivals(obstacles, goal, config.arrivals)
    if len(arrivals) == 0:
        return result(PlanStatus.GOAL_BLOCKED, *nothing, 0)
    lookup = obstacles.lookup
    gx, gy = (float(v) for v in (goal[:2] - obstacles.origin) / obstacles.resolution)
    # A point may go where some heading of the car fits.
    passable = np.asarray((obstacles.levels < COLLIDING).any(axis=2))
    target = Goal(arrivals, goal_distance(passable, gx, gy) * np.float32(obstacles.resolution))
    touching = bool(obstacles.at(start) == COLLIDING)
    closed, searching = 0, began
    # Coarsely first; where that finds no path, arcs half as long may still shuttle the car out of a tight place.
    for scale in (1.0, 0.5):
        moves = arcs(1.5 * scale * config.cell, radius, config.steerings, obstacles.resolution)
        tree = _tree(obstacles, scale * config.cell, round(config.headings / scale))
        escape = config.escape_length if touching else 0.0
        if not hybrid_search.open_start(tree, lookup, target, radius, start, escape):
            return result(PlanStatus.START_BLOCKED if touching else PlanStatus.NO_PATH, *nothing, 0)
        # No node at first: a process that has to compile the search does so before the clock of the limit starts.
        state = hybrid_search.search(tree, lookup, target, moves, radius, costs, 0)
        if scale == 1.0:
            searching = time.perf_counter()
        while state == hybrid_search.UNFINISHED and closed + tree.counts[1] < max_expansions:
            if time.perf_counter() - searching > time_limit:
                break
            budget = int(min(_NODES_AT_ONCE, max_expansions - closed - tree.counts[1]))
            state = hybrid_search.search(tree, lookup, target, moves, radius, costs, budget)
        closed += int(tree.counts[1])
        if state != hybrid_search.EXHAUSTED:
            break
    last = len(tree.cost) - 1
    if state == hybrid_search.EXHAUSTED:
        stuck = touching and not (tree.escape[:last][tree.place[:last] == -2] == 0.0).any()
        return result(PlanStatus.START_BLOCKED if stuck else PlanStatus.NO_PATH, *nothing, closed)
    found = bool(np.isfinite(tree.cost[last]))
    poses, gears = _driven(tree, moves, radius, obstacles.resolution, last if found else int(tree.counts[2]))
    poses, gears = shortcut(lookup, poses, gears, radius, costs)
    return result(PlanStatus.FOUND if found else PlanStatus.TIME_OUT, poses, gears, closed)


def arcs(step: float, radius: float, steerings: int, part: float) -> Moves:
    """Return arcs of ``step`` m in both gears at even curvatures up to ``1 / radius``, in parts of ``part`` m."""
    share = np.tile(np.linspace(-1.0, 1.0, steerings), 2)
    gear = np.repeat([1.0, -1.0], steerings)
    count = max(1, math.ceil(step / part - 1e-9))
    s = gear[:, None] * step * np.arange(1, count + 1) / count
    return Moves(poses_after(0.0, s, s * share[:, None] / radius), gear, share, step)


def _pose(value: np.ndarray, sizes: tuple[int, ...], field: str) -> np.ndarray:
    pose = np.asarray(value, dtype=np.float64)
    if pose.ndim != 1 or len(pose) not in sizes or not np.isfinite(pose).all():
        raise InputError("hybrid_astar", field, f"{' or '.join(map(str, sizes))} finite numbers; found {value!r:.80}")
    return pose


def _arrivals(obstacles: FootprintLevels, goal: np.ndarray, headings: int) -> np.ndarray:
    """Return the goal poses ``(g, 3)`` without collision."""
    heading = goal[2:] if len(goal) == 3 else 2.0 * np.pi * np.arange(headings) / headings
    poses = np.stack([np.full_like(heading, goal[0]), np.full_like(heading, goal[1]), heading], axis=-1)
    return poses[obstacles.at(poses) < COLLIDING]


def _tree(obstacles: FootprintLevels, cell: float, headings: int) -> Tree:
    """Return an empty search over the whole table."""
    low = obstacles.origin - 0.5 * obstacles.resolution
    return hybrid_search.empty_tree(low, np.array(obstacles.levels.shape[:2]) * obstacles.resolution, cell, headings)


def _driven(tree: Tree, moves: Moves, radius: float, part: float, node: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poses ``(n, 3)`` and gears ``(n,)`` from the start to ``node``."""
    poses: list[np.ndarray] = []
    gears: list[np.ndarray] = []
    if node == len(tree.cost) - 1:
        node = int(tree.parent[node])
        curve = reeds_shepp.ReedsSheppPath(tree.pose[node], tree.curve[:, 0], tree.curve[:, 1].astype(np.int8), radius)
        points, gear = reeds_shepp.sample(curve, part)
        poses, gears = [points[1:]], [gear[1:]]
    while tree.parent[node] >= 0:
        parent, m = int(tree.parent[node]), tree.move[node]
        rows = [hybrid_search.advance(tree.pose[parent], d) for d in moves.displacement[m]]
        poses.insert(0, np.array(rows))
        gears.insert(0, np.full(len(rows), moves.gear[m], np.int8))
        node = parent
    gears.insert(0, gears[0][:1] if gears else np.ones(1, np.int8))
    return np.concatenate([tree.pose[node][None], *poses]), np.concatenate(gears)
