"""Plan by hybrid A* in a model of laser scans: a short drive that keeps away from what would be measured (eq. P47).

    min sum_edges  sum_parts |d| (1 + danger sum_i s(l_i)) + turn |turned|,    clearance(p) >= radius + margin

A cell of (x, y, heading) keeps the one continuous pose that reached it most cheaply, as DVBF-LM does; its successors
are the ends of random control sequences through the transition's mean, and the heuristic is the straight distance. The
planner sees nothing but predicted ranges: places where they are below the radius are blocked, and a motion must be
within the range predicted in its direction, so that a plan does not enter a place that is hidden behind a wall and of
which a learned model knows nothing.
"""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car.hybrid_search import EXHAUSTED, REACHED_GOAL, Tree, advance, empty_tree
from vssm_gym.planning.result import PlanStatus
from vssm_gym.planning.scans import search
from vssm_gym.planning.scans.control_sequences import Motions
from vssm_gym.planning.scans.range_table import RangeTable
from vssm_gym.planning.scans.search import Edges, clearance_at


@dataclass(frozen=True)
class ScanPlannerConfig:
    """Configure the search; lengths in m.

    Args:
        cell: of a node.
        headings: of a node.
        margins: beyond the robot's radius, tried in this order until there is a path.
        slack: by which a predicted range may fall short of a motion that it must allow.
        danger: extra cost a metre of a predicted range at and below ``near`` of the table.
        turn: cost of a radian.
        escape_length: that a start with too little clearance may drive to come free.
        escape: extra cost a metre there.
        floor: share of the radius that it keeps meanwhile.
        max_expansions: closed nodes after which the search gives up, over all margins.
    """

    cell: float = 0.02
    headings: int = 48
    margins: tuple[float, ...] = (0.0025, 0.0, -0.0025)
    slack: float = 0.004
    danger: float = 0.1
    turn: float = 0.003
    escape_length: float = 0.05
    escape: float = 10.0
    floor: float = 0.3
    max_expansions: int = 400_000

    def __post_init__(self) -> None:
        if not self.margins:
            raise InputError("ScanPlannerConfig", "margins", "at least one")
        if not (self.cell > 0.0 and self.headings >= 1):
            found = f"{self.cell!r} m and {self.headings!r}"
            raise InputError("ScanPlannerConfig", "cell", f"cells above 0 m and at least one heading; found {found}")


@dataclass(frozen=True)
class ScanPlan:
    """Hold a drive from the start to the goal region, or the reason why there is none.

    Attributes:
        status: how the search ended.
        poses: x, y (m), heading (rad) at the start and after each part of each control; empty without a path, the best
            partial one after a time-out.
        cost: of the drive; infinite without a path.
        seconds: wall-clock time of the whole call.
        expansions: nodes that the search closed, over all margins.
    """

    status: PlanStatus
    poses: Float[np.ndarray, "n 3"]
    cost: float
    seconds: float
    expansions: int

    @property
    def found(self) -> bool:
        """Return True if the drive ends inside the goal region."""
        return self.status is PlanStatus.FOUND


def plan(
    start: Float[np.ndarray, "3"],
    goal: Float[np.ndarray, "2"],
    table: RangeTable,
    motions: Motions,
    radius: float,
    *,
    goal_radius: float,
    config: ScanPlannerConfig | None = None,
) -> ScanPlan:
    """Plan a drive of a disc of ``radius`` from a pose to within ``goal_radius`` of a place.

    Args:
        start: x, y (m), heading (rad).
        goal: x, y, m.
        table: what the model predicts.
        motions: the control sequences.
        radius: of the body, m.
        goal_radius: m.
        config: of the search.

    Raises:
        InputError: a start or a goal that is not finite.
    """
    began, config = time.perf_counter(), config or ScanPlannerConfig()
    start, goal = _finite(start, 3, "start"), _finite(goal, 2, "goal")
    closed, nothing = 0, np.empty((0, 3))
    low = np.array([table.x, table.y])
    extent = table.spacing * (np.array(table.clearance.shape) - 1)
    here = clearance_at(table, start[0], start[1])
    status = PlanStatus.NO_PATH if here >= config.floor * radius else PlanStatus.START_BLOCKED
    for margin in config.margins:
        need = radius + margin
        floor = min(config.floor * radius, 0.9 * max(here, 0.0))
        edges = Edges(need, floor, config.slack, config.danger, config.turn, config.escape)
        tree = empty_tree(low, extent, config.cell, config.headings)
        if not search.open_at(tree, start, goal, config.escape_length if here < need else 0.0):
            break
        left = config.max_expansions - closed
        code = search.search(tree, table, motions, edges, goal, goal_radius, left)
        closed += int(tree.counts[1])
        if code != EXHAUSTED:
            node = int(tree.counts[2])
            found = PlanStatus.FOUND if code == REACHED_GOAL else PlanStatus.TIME_OUT
            poses = _driven(tree, motions, node)
            return ScanPlan(found, poses, float(tree.cost[node]), time.perf_counter() - began, closed)
    return ScanPlan(status, nothing, np.inf, time.perf_counter() - began, closed)


def _driven(tree: Tree, motions: Motions, node: int) -> Float[np.ndarray, "n 3"]:
    """Return the poses from the start to ``node``."""
    poses: list[tuple[float, float, float]] = []
    while tree.parent[node] >= 0:
        parent, m = int(tree.parent[node]), tree.move[node]
        poses[:0] = [advance(tree.pose[parent], d) for d in motions.displacement[m]]
        node = parent
    path = np.array([tuple(tree.pose[node]), *poses])
    path[:, 2] = wrap_angle(path[:, 2])
    return path


def _finite(value: np.ndarray, size: int, field: str) -> np.ndarray:
    found = np.asarray(value, dtype=np.float64)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise InputError("plan", field, f"{size} finite numbers; found {value!r:.80}")
    return found
