"""Navigate to a goal: localise, plan, steer, and decide when to stop.

The planning agents share this navigator and differ only in their localizer, as published (TNP-SM). The planner is any
of :mod:`vssm_gym.planning.planners`, A* by default. The map is static: its clearance is computed once per map, and the
planner runs once per goal. After that each step shortens what is left of the plan from the newest estimate, and the
planner runs again only where that fails. A robot whose estimate is not believed never arrives: it drives on by its
commands for a while, then looks around, and in the end gives up (:class:`~vssm_gym.agents.shared.trust.LostConfig`).
"""

import math
import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.shared.localization import Localization, Localizer
from vssm_gym.agents.shared.trust import Conduct, LostConfig, gave_up
from vssm_gym.errors import InputError
from vssm_gym.maps.columns import BODY_HEIGHTS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.grid_search.clearance_requirement import requirement_from
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.planners import Planner, find_planner
from vssm_gym.planning.pursuit import steer
from vssm_gym.planning.result import PlanResult


@dataclass(frozen=True)
class NavigationConfig:
    """Configure how carefully to plan, when to stop, and when the robot is stuck; lengths in metres."""

    planner: str | Planner = "astar"  # a name of vssm_gym.planning.planners, or any planner
    heights: tuple[float, float] = BODY_HEIGHTS  # of the robot's body above the floor
    resolution: float = 0.025  # of the clearance grid
    # Extra clearance of a plan: a comfortable one; none; less than the radius, because learned walls have an error.
    margins: tuple[float, float, float] = (0.03, 0.0, -0.03)
    tight_share: float = 0.9  # the plan without margin is taken where its length is below this fraction of the other's
    slack: float = (
        0.015  # clearance by which following requires less than planning, so that small errors cause no new plan
    )
    stop_margin: float = 0.01  # inside the success radius, for errors that the estimate's covariance leaves out
    stop_sigmas: float = 2.5  # further inside, in standard deviations of the estimated position
    least_radius: float = 0.05  # the robot stops so near to the goal, however uncertain its estimate is
    landing: float = 0.002  # the path ends so far inside the stop radius; a step that ended short would cost another
    stuck_length: float = 0.4  # length of driving commands over which progress is measured
    stuck_share: float = 0.35  # fraction of it that the estimate must have moved; less means that the robot is stuck
    obstacle_radius: float = 0.03  # of the obstacle that is then assumed at the robot's front
    max_failures: int = 12  # steps without any plan after which the robot stops with a reason
    lost: LostConfig = field(default_factory=LostConfig)  # what to do without an estimate that may be believed


@dataclass
class _Task:
    """Hold what the navigator remembers about the present goal."""

    goal: np.ndarray
    path: np.ndarray | None = None  # (n, 2) what is left of the plan, from the last estimate
    margin: float = 0.0  # m, extra clearance of the plan
    rim: float = 0.0  # m, radius of the goal region where the plan could not lead to a safer one
    failures: int = 0  # steps in a row without a plan
    before: np.ndarray | None = None  # xy where the last driving command was given
    driven: deque[tuple[float, float]] = field(default_factory=deque)  # m commanded and m moved, of recent commands


class Navigator:
    """Drive to ``observation["goal"]`` by the pose that a localizer estimates, then stop."""

    def __init__(self, localizer: Localizer, config: NavigationConfig) -> None:
        self._localizer, self._config = localizer, config
        self._plan = find_planner(config.planner)
        self._map: VoxelMap | None = None
        self._static: ClearanceMap  # of that map, kept over episodes

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing.

        A plan is made and dropped: the latencies include the first step's plan and no compilation.
        """
        if context.map is None:
            raise InputError("AgentContext", "map", "a learned map: this agent plans in one")
        if context.map is not self._map:
            low, high = self._config.heights
            self._static = ClearanceMap.from_voxel_map(context.map, low, high, self._config.resolution)
            self._map = context.map
        self._context = context
        self._command: np.ndarray | None = None
        self._estimate = self._localizer.reset(context, observation)
        self._begin(observation["goal"])
        for _ in range(2):  # to plan, and to follow the plan
            self._follow(self._estimate)
        self._begin(observation["goal"])

    def act(self, observation: Observation) -> Decision:
        """Return the next action from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if self._command is not None:
            self._estimate = self._localizer.update(self._command, observation)
        estimate = self._estimate
        tracked = time.perf_counter()
        if not np.array_equal(observation["goal"], self._task.goal):
            self._begin(observation["goal"])
        activity, stop, command = self._decide(estimate)
        planned = time.perf_counter()
        if command is None:
            assert self._task.path is not None
            context = self._context
            command = steer(estimate.planar, self._task.path, context.limits, context.direction_frame)
        self._remember(estimate, command)
        ended = time.perf_counter()
        latency = {"tracking": tracked - began, "planning": planned - tracked, "control": ended - planned}
        action = np.array([*command, float(stop)], np.float32)
        status = f"{activity}; localization: {estimate.status}"
        gives_up = activity.startswith("gave up")
        return Decision(action, estimate.planar.copy(), status, latency, self._task.path, gives_up, estimate.covariance)

    def _begin(self, goal: np.ndarray) -> None:
        """Begin a task, with no plan and without the obstacles that were assumed before."""
        self._task, self._clearance = _Task(np.array(goal, np.float64)), self._static

    def _decide(self, estimate: Localization) -> tuple[str, bool, np.ndarray | None]:
        """Return the activity, True to stop, and the command where it is not to follow the path."""
        task, still = self._task, np.array(STOP_COMMAND)
        stuck = self._stuck(estimate)
        if stuck:
            self._assume_obstacle(estimate)
        distance = math.hypot(*(estimate.planar[:2] - task.goal))
        near = distance <= self._stop_radius(estimate)
        turn, lost = np.array([self._context.limits[0], 0.0, 0.0]), "looking around: lost"
        match self._config.lost.conduct(estimate.lost, estimate.status):
            case Conduct.GIVE_UP:
                return gave_up(estimate.lost), True, still
            case Conduct.WAIT:
                return "waiting: lost", False, still
            case Conduct.SEARCH:
                return lost, False, turn
        if near:
            return (lost, False, turn) if estimate.lost else ("arrived", True, still)
        failure = self._follow(estimate)
        if distance <= task.rim + self._config.landing and task.path is not None:
            return (lost, False, turn) if estimate.lost else ("arrived as near as a path leads", True, still)
        if failure is None:
            return ("stuck: leaving" if stuck else "driving"), False, None
        task.failures += 1
        if task.failures > self._config.max_failures:
            return f"gave up: {failure.status.message}", True, still
        # Standing still changes nothing: turning may correct the estimate from which no path starts.
        return f"looking around: {failure.status.message}", False, turn

    def _stop_radius(self, estimate: Localization) -> float:
        """Return the distance to the goal (m) at which a stop is safe for the uncertainty of the estimate."""
        c = self._config
        spread = float(np.max(estimate.std[:2]))
        return max(c.least_radius, self._context.success_radius - c.stop_margin - c.stop_sigmas * spread)

    def _follow(self, estimate: Localization) -> PlanResult | None:
        """Update the task's path; return None, or the planner's last result where there is no path."""
        task, c = self._task, self._config
        target = self._stop_radius(estimate) - c.landing
        if task.path is not None:
            radius = max(target, task.rim)
            path = self._extended(task.path, radius)
            if path is not None:
                points = np.concatenate([estimate.planar[None, :2], path[1:]])
                asked = requirement_from(self._clearance, points[0], self._radius + task.margin - c.slack)
                path = shorten_path(self._clearance, points, task.goal, radius, asked)
            task.path = path
        return self._replan(estimate, target) if task.path is None else None

    def _extended(self, path: np.ndarray, radius: float) -> np.ndarray | None:
        """Extend the path straight to the goal's disc where that has shrunk since; None where that is not free."""
        offset = path[-1] - self._task.goal
        away = math.hypot(*offset)
        if away <= radius + 1e-9:
            return path
        end = self._task.goal + offset * (radius / away)
        between = np.linspace(path[-1], end, 2 + int((away - radius) / self._clearance.resolution))
        asked = self._radius + self._task.margin - self._config.slack
        return np.concatenate([path, [end]]) if self._clearance.at(between).min() >= asked else None

    def _replan(self, estimate: Localization, target: float) -> PlanResult | None:
        """Plan with a margin and without one; the path without is taken where it is much shorter.

        Where neither exists, plan with less than the radius, because a learned wall may stand too far out; then to all
        of the success region; then without the assumed obstacles.
        """
        c, task = self._config, self._task
        rim = self._context.success_radius - 2.0 * c.landing
        wide, tight, squeezed = c.margins

        def attempt(clearance: ClearanceMap, margin: float, radius: float) -> PlanResult:
            return self._plan(estimate.planar, task.goal, clearance, self._radius, margin=margin, goal_radius=radius)

        def adopt(result: PlanResult, clearance: ClearanceMap, margin: float, radius: float) -> None:
            self._clearance, task.failures = clearance, 0
            task.path, task.margin, task.rim = result.path, margin, radius if radius > target else 0.0

        spare = attempt(self._clearance, wide, target)
        close = attempt(self._clearance, tight, target)
        if spare.found and close.cost >= c.tight_share * spare.cost:
            adopt(spare, self._clearance, wide, target)
            return None
        if close.found:
            adopt(close, self._clearance, tight, target)
            return None
        last = close
        for settings in (
            (self._clearance, squeezed, target),
            (self._clearance, squeezed, rim),
            (self._static, tight, target),
            (self._static, squeezed, rim),
        ):
            last = attempt(*settings)
            if last.found:
                adopt(last, *settings)
                return None
        task.path = None
        return last

    @property
    def _radius(self) -> float:
        return 0.5 * self._context.body_length

    def _remember(self, estimate: Localization, command: np.ndarray) -> None:
        self._command = np.asarray(command, np.float32)
        self._task.before = estimate.planar[:2].copy() if command[2] > 0.0 else None

    def _stuck(self, estimate: Localization) -> bool:
        """Return True where the last driving commands moved the estimate by much less than they commanded."""
        task, c = self._task, self._config
        if task.before is not None and self._command is not None:
            task.driven.append((float(self._command[2]), math.hypot(*(estimate.planar[:2] - task.before))))
        asked, moved = (sum(values) for values in zip(*task.driven, strict=True)) if task.driven else (0.0, 0.0)
        while task.driven and asked - task.driven[0][0] >= c.stuck_length:
            asked, moved = asked - task.driven[0][0], moved - task.driven[0][1]
            task.driven.popleft()
        return asked >= c.stuck_length and moved < c.stuck_share * asked

    def _assume_obstacle(self, estimate: Localization) -> None:
        """Assume an obstacle at the robot's front, or where it drives to in the world frame, and plan around it."""
        heading = estimate.planar[2]
        if self._context.direction_frame == "world" and self._command is not None:
            heading = float(self._command[1])
        front = self._radius + self._config.obstacle_radius
        centre = estimate.planar[:2] + front * np.array([math.cos(heading), math.sin(heading)])
        self._clearance = self._clearance.with_obstacle(centre, self._config.obstacle_radius)
        self._task.path = None
        self._task.driven.clear()
