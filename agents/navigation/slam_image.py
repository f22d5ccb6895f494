"""Explore an apartment that nobody has mapped until the map shows where the goal's image was taken, and drive there.

``slam_image`` reads RGB-D, its own commands and the goal's image. It drives as ``slam_nav`` on the map that PRISM builds:
to one frontier after the other, while :class:`~vssm_gym.agents.shared.picture_search.PictureSearch` looks in that map for
poses that explain the image. It drives to such a pose, turns to where the image should have looked, and compares the
camera's image with it. Described in ``docs/agents/navigation.md``.
"""

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.exploration.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.navigation.slam_nav import CONFIG
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.manoeuvres import Turn
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.agents.shared.navigator import NavigationConfig, Navigator
from vssm_gym.agents.shared.picture_search import Match, PictureSearch, PictureSearchConfig
from vssm_gym.agents.shared.recovery import IN_OWN_MAP, Failure, Response
from vssm_gym.agents.shared.strategy import Choice, Situation
from vssm_gym.agents.shared.surroundings import GrowingMap
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.frontier import frontier_cells
from vssm_gym.planning.floor_plan import FloorPlan

import os
DEBUG = os.environ.get("DBG")


@dataclass(frozen=True)
class SlamImageConfig:
    """Configure which poses are believed, and how near to drive; lengths in metres."""

    navigation: NavigationConfig = field(
        default_factory=lambda: replace(CONFIG, responses={**IN_OWN_MAP, Failure.NO_PATH: (Response.LOOK_AGAIN,)})
    )
    search: PictureSearchConfig = field(default_factory=PictureSearchConfig)
    frontiers: FrontierGainConfig = field(default_factory=FrontierGainConfig)
    near: float = 0.25  # radius around a pose within which the robot stops
    correlation: float = 0.7  # of picture and map, to drive there
    share: float = 0.4  # of the picture that the map shows
    same_place: tuple[float, float] = (0.5, 0.4)  # m, rad: matches that are nearer are one


class SlamImageAgent:
    name = "slam_image"
    robot = "holonomic"
    task = "imagegoal"
    needs_pose = False
    needs_map = False

    def __init__(self, config: SlamImageConfig | None = None) -> None:
        self._config = config or SlamImageConfig()
        self._surroundings = GrowingMap(MapAndPose())
        self._navigator = Navigator(self._surroundings, self._config.navigation)
        self._strategy = FrontierGain(self._config.frontiers)

    @property
    def map(self) -> VoxelMap:
        return self._surroundings.map

    @property
    def plan(self) -> FloorPlan | None:
        return self._plan

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        self._context = replace(context, success_radius=min(self._config.near, context.success_radius))
        self._open(observation, seed)
        self._navigator.reset(self._context, self._with_goal(observation), seed)
        self._plan = self._surroundings.floor_plan()
        self._search.step(self._surroundings.map, self._plan)
        self._search.align(self._surroundings.map, [np.asarray(context.start_pose, np.float64)])
        self._open(observation, seed)

    def _open(self, observation, seed):
        self._strategy.reset(seed)
        self._picture = observation["goal_rgb"].astype(np.float32) / 255.0
        self._search = PictureSearch(self._config.search, self._context, self._picture)
        self._target = np.asarray(self._context.start_pose, np.float64)[:2]
        self._choice = None
        self._match: Match | None = None
        self._refuted: list[np.ndarray] = []
        self._dismissed: list[np.ndarray] = []
        self._turn = None
        self._past = Counter()
        self.log = []
        self._n = 0

    def _with_goal(self, observation):
        return {**observation, "goal": self._target}

    def act(self, observation: Observation) -> Decision:
        self._n += 1
        decision = self._navigator.act(self._with_goal(observation))
        estimate = self._navigator.estimate
        if estimate.lost:
            return decision
        self._plan = plan = self._surroundings.floor_plan()
        found = self._search.step(self._surroundings.map, plan)
        if found is not None:
            self._consider(found)
        if self._match is None and self._is_obsolete(plan):
            return self._explore(decision, estimate, plan)
        if decision.action[3] < 0.5:
            return self._named(decision)
        if self._match is not None:
            return self._compare(decision, observation, estimate, plan)
        if not decision.gives_up and self._choice is not None:
            if self._turn is None:
                dx, dy = self._choice.target.mean(axis=0) - estimate.planar[:2]
                self._turn = Turn([math.atan2(dy, dx)], float(self._context.limits[0]))
            command = self._turn.command(estimate.planar)
            if command is not None:
                return self._instead(decision, command, "looks at a frontier")
        if self._choice is not None:
            self._dismissed.append(self._choice.target if decision.gives_up else self._left(plan))
            if decision.gives_up:
                self._dismissed.append(self._choice.goal[None])
        return self._explore(decision, estimate, plan)

    def _named(self, decision):
        what = "explores" if self._match is None else "drives to a match"
        return replace(decision, status=f"{what}; {decision.status}", gives_up=False)

    def _instead(self, decision, command, status):
        self._navigator.instead(command)
        return replace(decision, action=np.array([*command, 0.0], np.float32), status=status, gives_up=False)

    def _consider(self, found):
        if DEBUG:
            for one in found:
                self.log.append((self._n, one))
        c = self._config
        if self._match is not None:
            return
        for one in found:
            if one.correlation >= c.correlation and one.share >= c.share and not self._is_refuted(one):
                self._match, self._turn, self._choice = one, None, None
                self._target = one.planar[:2].copy()
                if DEBUG: print(self._n, "match", one)
                return

    def _is_refuted(self, one):
        place, heading = self._config.same_place
        return any(math.hypot(*(one.planar[:2] - p[:2])) < place and abs(float(wrap_angle(one.planar[2] - p[2]))) < heading for p in self._refuted)

    def _compare(self, decision, observation, estimate, plan):
        assert self._match is not None
        if not decision.gives_up:
            if self._turn is None:
                self._turn = Turn([float(self._match.planar[2])], float(self._context.limits[0]))
            command = self._turn.command(estimate.planar)
            if command is not None:
                return self._instead(decision, command, "turns to where the image looked")
            again = self._search.align(self._surroundings.map, [self._match.planar])[0]
            if DEBUG: print(self._n, "at match", self._match, again)
            if again.correlation >= self._config.correlation and again.share >= self._config.share:
                if math.hypot(*(again.planar[:2] - self._target)) > 0.15:
                    self._target, self._match, self._turn = again.planar[:2].copy(), again, None
                    return self._instead(decision, np.zeros(3), "corrects")
                return decision
        if DEBUG: print(self._n, "refuted", decision.status)
        self._refuted.append(self._match.planar)
        self._match = None
        return self._explore(decision, estimate, plan)

    def _is_obsolete(self, plan):
        return self._choice is not None and len(self._left(plan)) <= 0.2 * len(self._choice.target)

    def _left(self, plan):
        target = self._choice.target
        cell = np.clip(plan.index(target), 0, np.array(plan.cells.shape) - 1)
        return target[frontier_cells(plan.cells)[cell[:, 0], cell[:, 1]]]

    def _explore(self, decision, estimate, plan):
        if decision.gives_up and estimate.lost:
            return decision
        radius = 0.5 * self._context.body_length
        dismissed = np.concatenate(self._dismissed) if self._dismissed else np.empty((0, 2))
        self._turn = None
        for margin in (0.03, 0.01, -0.01):
            roadmap = Roadmap.of(plan, estimate.planar[:2], radius + margin)
            situation = Situation(self.map, roadmap, estimate.planar, estimate.std, None, None, dismissed, True)
            choice = self._strategy.choose(situation)
            if choice is not None:
                self._choice, self._target = choice, np.asarray(choice.goal, np.float64)
                return self._instead(decision, np.zeros(3), choice.status)
        return replace(decision, action=np.array([*STOP_COMMAND, 1.0], np.float32), status="gave up: explored", gives_up=True)
