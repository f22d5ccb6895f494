"""Drive an explorer: update the map, read its floor plan, choose a viewpoint, follow a path to it.

Explorers share this driver. They differ in their :class:`~vssm_gym.agents.shared.strategy.ExplorationStrategy` and in
their mapper, which observes the pose or estimates it. The map is the agent's own. Every episode begins with a full
turn. The explorer chooses again every ``replan_steps``, when a choice is completed or its target has been seen, and
when an unforeseen obstacle blocks the path. A robot whose estimate is not believed turns in place until images fit its
map again, and gives up in the end (:class:`~vssm_gym.agents.shared.trust.LostConfig`).
:mod:`vssm_gym.agents.shared.following` follows the paths and handles steps that cannot be taken.
"""

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.shared.following import BlockedSteps, Follower, FollowingConfig, PlannedPath, roomier
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.mapping import MapAtObservedPose, Mapper
from vssm_gym.agents.shared.own_map import OwnMap, OwnMapConfig
from vssm_gym.agents.shared.strategy import Choice, ExplorationStrategy, Situation, around
from vssm_gym.agents.shared.trust import Conduct, LostConfig, gave_up
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.frontier import frontier_cells
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.planners import Planner, find_planner

FULL = "finished: the map has no room for more"


@dataclass(frozen=True)
class ExplorationConfig:
    """Configure how paths are planned, how often to choose, and when to stop; lengths in metres."""

    planner: str | Planner = "astar"  # a name of vssm_gym.planning.planners, or any planner
    margins: tuple[float, ...] = (0.08, 0.03)  # clearance beyond the robot's radius; the first with a choice is taken
    replan_steps: int = 5
    known_share: float = 0.8  # fraction of a target's frontier cells that are known, from which on it is obsolete
    max_failures: int = 25  # steps in a row without a path or a step to take, after which the robot is boxed in
    arrival: float = 0.1  # distance at which a goal is reached: the execution error of a step is as large
    aligned: float = 0.12  # rad, at which a heading is reached: the same for a turn
    retreat_steps: int = 8  # steps beyond ``replan_steps`` that a retreat may take, half a turn included
    following: FollowingConfig = field(default_factory=FollowingConfig)
    # An explorer that drives where it has seen nothing yet cannot do without its pose: it never coasts.
    lost: LostConfig = field(default_factory=lambda: LostConfig(coast=0))


class Explorer:
    """Drive where the strategy chooses until it finds nothing left, then stop."""

    def __init__(
        self,
        strategy: ExplorationStrategy,
        mapper: Mapper | None = None,
        config: ExplorationConfig | None = None,
        own: OwnMapConfig | None = None,
    ) -> None:
        self._strategy, self._mapper = strategy, mapper or MapAtObservedPose()
        self._config, self._own_config = config or ExplorationConfig(), own or OwnMapConfig()
        self._plan_path = find_planner(self._config.planner)
        self._own: OwnMap

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._own.map

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode in an unknown world.

        A step and a choice are made and dropped, so that no step's latency includes compilation.
        """
        self._context, self._follower = context, Follower.of(context, self._config.following)
        self._begin(observation, seed)
        self._own.take(np.zeros(3), observation)
        self._choose(self._own.estimate, self._own.plan())
        self._begin(observation, seed)

    def _begin(self, observation: Observation, seed: int) -> None:
        self._own = OwnMap(self._context, self._mapper, self._own_config, observation)
        self._strategy.reset(seed)
        heading = float(self._own.estimate.planar[2])
        self._choice: Choice | None = Choice(None, around(heading), None, "turns around once")
        self._sent: np.ndarray | None = None  # the last command; the first observation is in the map already
        self._path: PlannedPath | None = None  # to the choice's goal; None at it
        self._arrived, self._failed = True, ""
        self._age = self._failures = 0
        self._blocked_steps = BlockedSteps(self._config.following)
        self._dismissed: list[np.ndarray] = []

    def act(self, observation: Observation) -> Decision:
        """Return the next action from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if self._sent is not None:
            self._own.take(self._sent, observation)
        estimate = self._own.estimate
        mapped = time.perf_counter()
        gives_up = self._config.lost.conduct(estimate.lost, estimate.status) is Conduct.GIVE_UP
        if estimate.lost:
            command, activity, stop = self._search(estimate)
            planned = mapped
        else:
            finished = FULL if self._own.is_full else self._plan(estimate)
            planned = time.perf_counter()
            command, activity, stop = self._drive(estimate.planar, finished)
        ended = time.perf_counter()
        self._sent = command
        latency = {"tracking": mapped - began, "planning": planned - mapped, "control": ended - planned}
        action = np.array([*command, float(stop)], np.float32)
        path = None if self._path is None else self._path.path
        return Decision(action, estimate.planar.copy(), activity, latency, path, gives_up, estimate.covariance)

    def _search(self, estimate: Localization) -> tuple[np.ndarray, str, bool]:
        """Look for an image that fits; return command, activity, and True to stop."""
        self._choice = self._path = None
        conduct = self._config.lost.conduct(estimate.lost, estimate.status)
        if conduct is Conduct.GIVE_UP:
            return np.array(STOP_COMMAND), f"{gave_up(estimate.lost)}; localization: {estimate.status}", True
        if conduct is Conduct.WAIT:
            return np.array(STOP_COMMAND), f"waiting: lost; localization: {estimate.status}", False
        command = np.array([self._context.limits[0], 0.0, 0.0])
        return command, f"looking around: lost; localization: {estimate.status}", False

    def _plan(self, estimate: Localization) -> str | None:
        """Keep the choice or choose again; return the reason where nothing is left to do."""
        planar, floor = estimate.planar, self._own.plan()
        self._age += 1
        self._near = floor.clearance(planar[:2], 1.2)
        if self._done(planar):
            self._close(self._left(floor))
        if self._obsolete(floor) or self._stale(planar, self._near):
            self._choice = None
        if self._choice is not None and self._path is not None:
            self._path = self._follower.shortened(self._path, planar)
            if self._path is None:
                self._choice = None
        return self._choose(estimate, floor) if self._choice is None else None

    def _drive(self, planar: np.ndarray, finished: str | None) -> tuple[np.ndarray, str, bool]:
        """Return the next command of the choice, the activity, and True to stop."""
        if finished:
            return np.array(STOP_COMMAND), finished, True
        command, activity = self._command(planar, self._near)
        if self._failures > self._config.max_failures:
            return np.array(STOP_COMMAND), "boxed in: no step leads out", True
        return command, activity, False

    def _done(self, planar: np.ndarray) -> bool:
        """Return True where the robot is at the chosen goal and has taken images in all chosen headings."""
        if self._choice is None:
            return False
        if self._path is not None and math.hypot(*(self._path.path[-1] - planar[:2])) <= self._config.arrival:
            self._path = None
        headings = list(self._choice.headings)
        while (
            headings and self._path is None and abs(float(wrap_angle(headings[0] - planar[2]))) < self._config.aligned
        ):
            headings.pop(0)
        self._choice = replace(self._choice, headings=tuple(headings))
        return self._path is None and not headings

    def _left(self, floor: FloorPlan) -> np.ndarray:
        """Return the cells of the choice's target that are still frontiers, ``(n, 2)`` m."""
        target = None if self._choice is None else self._choice.target
        if target is None:
            return np.empty((0, 2))
        cell = np.clip(floor.index(target), 0, np.array(floor.cells.shape) - 1)
        return target[frontier_cells(floor.cells)[cell[:, 0], cell[:, 1]]]

    def _obsolete(self, floor: FloorPlan) -> bool:
        """Return True where the target of the choice has been seen meanwhile."""
        choice = self._choice
        if choice is None or choice.target is None:
            return False
        return len(self._left(floor)) <= (1.0 - self._config.known_share) * len(choice.target)

    def _stale(self, planar: np.ndarray, near: ClearanceMap) -> bool:
        """Return True where the choice has to be made again, or its path is not free any more."""
        if self._choice is None or self._path is None:
            return False  # at the goal every heading of the choice is turned to first
        return self._age >= self._config.replan_steps or self._follower.blocked(self._path, planar, near)

    def _choose(self, estimate: Localization, floor: FloorPlan) -> str | None:
        """Choose and plan the path; return the reason where nothing is left to do."""
        self._age, self._path = 0, None
        radius, planar, std = self._follower.radius, estimate.planar, self._ahead(estimate.std)
        reached, failed, least = 0, "", 0.5 * self._config.margins[-1]
        for margin in self._config.margins:
            roadmap = Roadmap.of(floor, planar[:2], radius + margin)
            reached = int(np.isfinite(roadmap.distance).sum())
            dismissed = np.concatenate(self._dismissed) if self._dismissed else np.empty((0, 2))
            own = self._own
            situation = Situation(own.map, roadmap, planar, std, own.camera, own.T_body_cam, dismissed, self._arrived)
            choice = self._strategy.choose(situation)
            if choice is None:
                continue
            self._choice, self._arrived = choice, False
            if choice.goal is None:
                return None
            # The roadmap tests its edges less closely than a planner, so a path may need a smaller margin.
            for tight in (margin, max(0.5 * margin, least), least):
                result = self._plan_path(
                    planar, choice.goal, roadmap.clearance, radius, margin=tight, goal_radius=self._config.arrival
                )
                if result.found:
                    self._path = PlannedPath(result.path, roadmap.clearance, tight) if len(result.path) > 1 else None
                    return None
            failed = result.status.message
        if failed:
            self._failures, self._failed = self._failures + 1, failed
            self._give_up()
            return None
        room = reached * floor.resolution**2
        return "finished: nothing left to gain" if room > math.pi * radius**2 else "boxed in: no free place to go"

    def _ahead(self, std: np.ndarray) -> np.ndarray:
        """Predict the pose's standard deviations at the next choice; zeros where the pose is observed."""
        turn, step = self._context.noise
        grown = np.sqrt(std**2 + self._config.replan_steps * np.array([step, step, turn]) ** 2)
        return np.where(std > 0.0, grown, 0.0)

    def _close(self, vain: np.ndarray) -> None:
        """End the choice; ``vain`` ``(n, 2)``, m, are cells that are still unknown and cannot be seen from there."""
        if len(vain):
            self._dismissed.append(vain)
        self._choice, self._arrived = None, True

    def _give_up(self) -> None:
        """Give up the choice, which the robot cannot reach."""
        choice = self._choice
        parts = [] if choice is None else [a.reshape(-1, 2) for a in (choice.goal, choice.target) if a is not None]
        self._close(np.concatenate(parts) if parts else np.empty((0, 2)))

    def _command(self, planar: np.ndarray, near: ClearanceMap) -> tuple[np.ndarray, str]:
        """Return one step along the path, or one turn towards the next heading, and the activity."""
        limits = self._context.limits
        choice = self._choice
        if choice is None:  # no path was found
            return np.array([limits[0], 0.0, 0.0]), self._failed
        if self._path is not None:
            command = self._follower.step(self._path, planar, near, self._failures)
            if np.any(command != 0.0):
                self._failures = 0 if command[2] > 0.0 else self._failures
                return command, choice.status
            self._retreat(self._path, planar, near)
            return np.array([limits[0], 0.0, 0.0]), "blocked: turns in place"
        if not choice.headings:
            return np.array(STOP_COMMAND), choice.status
        turn = float(np.clip(wrap_angle(choice.headings[0] - planar[2]), -limits[0], limits[0]))
        return np.array([turn, 0.0, 0.0]), choice.status

    def _retreat(self, planned: PlannedPath, planar: np.ndarray, near: ClearanceMap) -> None:
        """Handle a path along which no step is allowed: retreat, or choose again from here."""
        self._failures += 1
        if self._blocked_steps.add(planar[:2]):
            self._give_up()
        self._choice, self._path = None, None
        if (place := roomier(planar, near, self._config.following.retreat)) is not None:
            self._path = replace(planned, path=np.stack([planar[:2], place]))
            self._choice, self._age = (
                Choice(self._path.path[-1], (), None, "retreats from an obstacle"),
                -self._config.retreat_steps,
            )
