"""Drive to a goal in a model of scans: localise, plan by hybrid A*, follow, and plan anew where the drive is left.

DVBF-LM, section VI-A. Model, localizer and goals are given: the bound has the true map and the true pose.
"""

import math
import time
from dataclasses import dataclass, field

import equinox as eqx
import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.shared.scans.following import follow, free_ahead, progress
from vssm_gym.agents.shared.scans.localization import ScanLocalizer
from vssm_gym.agents.shared.scans.surprises import Surprises
from vssm_gym.errors import InputError
from vssm_gym.planning.scans.control_sequences import motions, random_controls
from vssm_gym.planning.scans.hybrid_astar import ScanPlan, ScanPlannerConfig, plan
from vssm_gym.planning.scans.range_table import RangeTableConfig, range_table

CONTROLS_SEED = 0  # of the one set of control sequences


@dataclass(frozen=True)
class ScanNavigation:
    """Configure the navigator; lengths in m, angles in rad.

    Args:
        low: x, y of the plane's lowest corner: the mazes fill the unit square.
        high: of its highest.
        table: of predicted ranges.
        planner: of the search.
        sequences: of random controls at a node.
        steps: of each.
        goal_radius: within which a drive may end.
        particles: of a filtered pose.
        arrived: share of the success radius within which it stops.
        off: distance from the drive at which it plans anew.
        look: distance along the drive that it aims at.
        faced: angle from its aim within which it drives.
        near: range up to which readings are compared with the model.
        patience: failed searches in a row after which it gives up.
    """

    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] = (1.0, 1.0)
    table: RangeTableConfig = field(default_factory=RangeTableConfig)
    planner: ScanPlannerConfig = field(default_factory=ScanPlannerConfig)
    sequences: int = 32
    steps: int = 3
    goal_radius: float = 0.012
    particles: int = 64
    arrived: float = 0.15
    off: float = 0.012
    look: float = 0.025
    faced: float = math.radians(20.0)
    near: float = 0.2
    patience: int = 10


class ScanNavigator:
    """Act on ``observation["goal"]``.

    Args:
        localizer: of the pose.
        config: of planning and following.
    """

    def __init__(self, localizer: ScanLocalizer, config: ScanNavigation) -> None:
        self._localizer, self._config = localizer, config
        self._prepared: AgentContext | None = None

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; what the model predicts is asked once a model."""
        if context.scan_model is None:
            raise InputError("AgentContext", "scan_model", "a model of scans, in which this agent plans")
        self._prepare(context)
        self._context = context
        self._here = self._localizer.reset(context, observation, seed)
        self._command: tuple[float, float] | None = None
        self._goal, self._path, self._segment = np.full(2, np.nan), np.empty((0, 2)), 0
        self._plan: ScanPlan | None = None
        self._failed, self._expansions, self._plans = 0, 0, 0
        self._surprises.forget()

    def act(self, observation: Observation) -> Decision:
        """Return the next command; the goal may change between two calls."""
        return self.towards(np.asarray(observation["goal"], np.float64), observation)

    def towards(self, goal: np.ndarray, observation: Observation) -> Decision:
        """Return the next command on the way to a goal x, y (m)."""
        began = time.perf_counter()
        if self._command is not None:
            turn, step = self._command
            self._here = self._localizer.update(np.array([turn, 0.0, step]), observation)
        tracked = time.perf_counter()
        if not np.array_equal(goal, self._goal):
            self._goal, self._plan, self._failed = goal, None, 0
        pose = self._here.planar
        left = math.hypot(*(goal - pose[:2]))
        if left <= self._config.arrived * self._context.success_radius:
            return self._decision(0.0, 0.0, True, "arrived", began, tracked)
        ranges, angles = np.asarray(observation["scan"], np.float64), np.asarray(self._angles, np.float64)
        met = self._surprises.look(pose, ranges, angles)
        if self._plan is not None and len(met) and self._blocks(met):
            self._plan = None
        if self._plan is not None:
            at = progress(self._path, pose[:2], self._segment)
            if at.distance > self._config.off:
                self._plan = None
        if self._plan is None:
            self._search(pose, goal)
        if self._plan is None:
            if self._failed >= self._config.patience:
                return self._decision(0.0, 0.0, True, self._status, began, tracked, gives_up=True)
            return self._decision(float(self._context.limits[0]), 0.0, False, self._status, began, tracked)
        at = progress(self._path, pose[:2], self._segment)
        self._segment = at.segment
        limits = np.asarray(self._context.limits, np.float64)
        turn, step = follow(pose, self._path, at, limits, self._config.look, self._config.faced)
        step = min(step, free_ahead(ranges, angles, 0.5 * self._context.body_length))
        return self._decision(turn, step, False, "driving", began, tracked)

    def _search(self, pose: np.ndarray, goal: np.ndarray) -> None:
        """Plan from a pose; a plan that is out of reach leaves none."""
        radius = 0.5 * self._context.body_length
        c = self._config
        found: ScanPlan = plan(
            pose, goal, self._surprises.table, self._motions, radius, goal_radius=c.goal_radius, config=c.planner
        )
        self._expansions, self._plans = self._expansions + found.expansions, self._plans + 1
        self._status = found.status.message
        if len(found.poses) < 1 or not found.found:
            self._failed += 1
            self._surprises.forget()  # one of them may have been none
            return
        self._failed, self._plan, self._segment = 0, found, 0
        self._path = np.concatenate([found.poses[:, :2], goal[None]])

    def _blocks(self, met: np.ndarray) -> bool:
        """Return whether a surface that was not predicted lies on the rest of the drive."""
        rest = self._path[self._segment :]
        away = np.hypot(*np.moveaxis(rest[:, None] - met[None], -1, 0))
        return bool(away.min() < 0.5 * self._context.body_length + self._config.planner.margins[0])

    def _prepare(self, context: AgentContext) -> None:
        """Ask a new model for its ranges, and a new robot for its motions."""
        before, c = self._prepared, self._config
        if before is None or before.scan_model is not context.scan_model:
            assert context.scan_model is not None
            table = range_table(context.scan_model, np.array(c.low), np.array(c.high), c.table)
            self._surprises = Surprises(table, c.near, 0.5 * context.body_length)
            self._angles = np.asarray(context.scan_model.scanner.angles)
        same = before is not None and np.array_equal(before.limits, context.limits)
        if not same or before is None or not eqx.tree_equal(before.transition, context.transition):
            controls = random_controls(CONTROLS_SEED, np.asarray(context.limits), c.sequences, c.steps)
            self._motions = motions(context.transition, controls, context.dt, c.table.spacing)
        self._prepared = context

    def _decision(
        self, turn: float, step: float, stop: bool, status: str, began: float, tracked: float, gives_up: bool = False
    ) -> Decision:
        """Return the decision and keep its command."""
        turn, step = (STOP_COMMAND[0], STOP_COMMAND[2]) if stop else (turn, step)
        action = np.array([turn, step, float(stop)], np.float32)
        self._command = float(action[0]), float(action[1])
        latency = {"tracking": tracked - began, "planning": time.perf_counter() - tracked}
        return Decision(
            action,
            self._here.planar.copy(),
            status,
            latency,
            None if self._plan is None else self._path[self._segment :].copy(),
            gives_up,
            self._here.covariance,
            {"planned anew": max(0, self._plans - 1)},
            self._expansions,
        )
