"""The driver that all explorers share: update the map -> read its floor plan -> choose where to go -> follow.

Explorers differ in their :class:`Strategy`, and in their mapper: the pose is observed (SPEC 8) or estimated. The map
is the agent's own. Every episode begins with a look around. A choice is made anew every ``replan_steps``, when it is
carried out or has become pointless, and when something unforeseen stands in its way. A robot that lost track turns on
the spot until an image fits its map again.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.localization import Localization
from vssm_gym.agents.mapping import MapAtObservedPose, Mapper
from vssm_gym.agents.own_map import OwnMap, OwnMapConfig
from vssm_gym.agents.strategy import Belief, Choice, Strategy, around
from vssm_gym.geometry import wrap_angle
from vssm_gym.planning.astar import needed, plan
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration import Roadmap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.frontier import frontier_cells
from vssm_gym.planning.pursuit import steer
from vssm_gym.planning.taut import tighten
from vssm_gym.voxel_map import VoxelMap

ARRIVED = 0.1  # m: closer to a goal it is not worth going, a step errs by as much
LEAST_STEP = 0.02  # m, worth its noise
TRIES = 4  # steps that are refused, within ``HELD``, after which a goal is given up
HELD = 0.5  # m
HELD_STEP = 0.15  # m: where nothing else is possible, so far to where there is more room
HELD_STEPS = 8  # that this may take beyond the usual, half a turn included
ALIGNED = 0.12  # rad, the same of a look
FULL = "finished: the map has no room for more"


@dataclass(frozen=True)
class ExploringConfig:
    """How carefully to drive and how often to choose; lengths in metres."""

    margins: tuple[float, ...] = (0.08, 0.03)  # clearance of a way beyond the robot's radius: the first that leads on
    replan_steps: int = 5
    guard: float = 0.015  # of clearance beyond the radius that a step keeps, whatever the noise does
    sigmas: float = 3.5  # of the execution noise that a step is prepared for
    daring: float = 0.8  # by which that shrinks with every step that was refused since the last one
    held_share: float = 0.6  # of the way's margin: more is not asked of a step, or it could not be driven
    lookahead: float = 0.6  # of the way ahead that is checked for something unforeseen at every step
    known_share: float = 0.8  # of a target's frontier cells, after which it is pointless to go there
    max_failures: int = 25  # steps in a row without a way or a step to take, after which the robot is boxed in
    max_lost: int = 64  # steps in a row without an image that fits: two whole turns


class Explorer:
    """Drives where its strategy chooses until that finds nothing left, then stops."""

    def __init__(
        self,
        strategy: Strategy,
        mapper: Mapper | None = None,
        config: ExploringConfig | None = None,
        own: OwnMapConfig | None = None,
    ) -> None:
        self._strategy, self._mapper = strategy, mapper or MapAtObservedPose()
        self._config, self._own_config = config or ExploringConfig(), own or OwnMapConfig()
        self._own: OwnMap

    @property
    def map(self) -> VoxelMap:
        """The belief over the apartment, world frame."""
        return self._own.map

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode in a world of which nothing is known.

        A step and a choice are made and dropped, so that compiling is no part of any step's latency.
        """
        self._context = context
        self._begin(observation, seed)
        self._own.take(np.zeros(3), observation)
        self._choose(self._own.estimate, self._own.plan())
        self._begin(observation, seed)

    def _begin(self, observation: Observation, seed: int) -> None:
        self._own = OwnMap(self._context, self._mapper, self._own_config, observation)
        self._strategy.reset(seed)
        heading = float(self._own.estimate.planar[2])
        self._choice: Choice | None = Choice(None, around(heading), None, "looks around")
        self._sent: np.ndarray | None = None  # the last command; the first observation is in the map already
        self._path: np.ndarray | None = None
        self._roadmap: Roadmap | None = None
        self._margin = self._config.margins[0]
        self._arrived, self._failed = True, ""
        self._age = self._failures = self._lost = self._refused = 0
        self._held = np.full(2, np.inf)  # where steps were refused last
        self._dismissed: list[np.ndarray] = []

    def act(self, observation: Observation) -> Decision:
        """The next action from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if self._sent is not None:
            self._own.take(self._sent, observation)
        estimate = self._own.estimate
        mapped = time.perf_counter()
        self._lost = self._lost + 1 if estimate.status != "ok" else 0
        if self._lost:
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
        return Decision(action, estimate.planar.copy(), activity, latency, self._path)

    def _search(self, estimate: Localization) -> tuple[np.ndarray, str, bool]:
        """A turn on the spot, where the last image did not fit: command, activity, whether to stop."""
        self._choice = self._path = None
        if self._lost > self._config.max_lost:
            return np.array(STOP_COMMAND), f"lost: {estimate.status}, in two whole turns", True
        return np.array([self._context.limits[0], 0.0, 0.0]), estimate.status, False

    def _plan(self, estimate: Localization) -> str | None:
        """Keep to the choice or choose anew; the reason where nothing is left to do."""
        planar, floor = estimate.planar, self._own.plan()
        self._age += 1
        self._near = floor.clearance(planar[:2], 1.2)
        if self._done(planar):
            self._close(self._left(floor))
        if self._pointless(floor) or self._stale(planar, self._near):
            self._choice = None
        if self._choice is not None and self._path is not None:
            self._path = self._followed(planar)
            if self._path is None:
                self._choice = None
        return self._choose(estimate, floor) if self._choice is None else None

    def _drive(self, planar: np.ndarray, finished: str | None) -> tuple[np.ndarray, str, bool]:
        """The next command of the choice, the activity and whether to stop."""
        if finished:
            return np.array(STOP_COMMAND), finished, True
        command, activity = self._command(planar, self._near)
        if self._failures > self._config.max_failures:
            return np.array(STOP_COMMAND), "boxed in: no step leads out", True
        return command, activity, False

    def _done(self, planar: np.ndarray) -> bool:
        """Whether the choice is carried out: the robot is there and has looked where it wanted to."""
        if self._choice is None:
            return False
        if self._path is not None and math.hypot(*(self._path[-1] - planar[:2])) <= ARRIVED:
            self._path = None
        looks = list(self._choice.looks)
        while looks and self._path is None and abs(float(wrap_angle(looks[0] - planar[2]))) < ALIGNED:
            looks.pop(0)
        self._choice = replace(self._choice, looks=tuple(looks))
        return self._path is None and not looks

    def _left(self, floor: FloorPlan) -> np.ndarray:
        """Which cells of the choice's target are frontiers still, ``(n, 2)`` m."""
        target = None if self._choice is None else self._choice.target
        if target is None:
            return np.empty((0, 2))
        cell = np.clip(floor.index(target), 0, np.array(floor.cells.shape) - 1)
        return target[frontier_cells(floor.cells)[cell[:, 0], cell[:, 1]]]

    def _pointless(self, floor: FloorPlan) -> bool:
        """Whether what the choice is about has been seen meanwhile."""
        choice = self._choice
        if choice is None or choice.target is None:
            return False
        return len(self._left(floor)) <= (1.0 - self._config.known_share) * len(choice.target)

    def _stale(self, planar: np.ndarray, near: ClearanceMap) -> bool:
        """Whether the way is to be chosen anew: by the clock, or because it is not free any more."""
        if self._choice is None or self._path is None:
            return False  # looks are carried out to their end
        if self._age >= self._config.replan_steps:
            return True
        least = self._radius + min(0.0, self._margin - 0.02)
        ahead = points_along(self._path, self._config.lookahead)
        return bool(near.at(ahead[1:]).min(initial=math.inf) < min(least, float(near.at(planar[:2])) - 0.01))

    def _choose(self, estimate: Localization, floor: FloorPlan) -> str | None:
        """Choose and plan the way; the reason where nothing is left to do."""
        self._age, self._path = 0, None
        planar, std = estimate.planar, self._ahead(estimate.std)
        reached, failed, least = 0, "", 0.5 * self._config.margins[-1]
        for margin in self._config.margins:
            roadmap = Roadmap.of(floor, planar[:2], self._radius + margin)
            reached = int(np.isfinite(roadmap.distance).sum())
            dismissed = np.concatenate(self._dismissed) if self._dismissed else np.empty((0, 2))
            own = self._own
            belief = Belief(own.map, roadmap, planar, std, own.camera, own.T_body_cam, dismissed, self._arrived)
            choice = self._strategy.choose(belief)
            if choice is None:
                continue
            self._choice, self._roadmap, self._margin, self._arrived = choice, roadmap, margin, False
            if choice.goal is None:
                return None
            # The roadmap's edges are looked at less closely than A*'s: a way may need less room than was asked.
            for tight in (margin, max(0.5 * margin, least), least):
                way = plan(roadmap.clearance, planar, choice.goal, self._radius, margin=tight, goal_radius=ARRIVED)
                if way.found:
                    self._margin, self._path = tight, way.path if len(way.path) > 1 else None
                    return None
            failed = way.status.message
        if failed:
            self._failures, self._failed = self._failures + 1, failed
            self._give_up()
            return None
        room = reached * floor.resolution**2
        return "finished: nothing left to gain" if room > math.pi * self._radius**2 else "boxed in: no free place to go"

    def _ahead(self, std: np.ndarray) -> np.ndarray:
        """The pose's standard deviations after as many steps as there are between choices; zeros where it is seen."""
        turn, step = self._context.noise
        grown = np.sqrt(std**2 + self._config.replan_steps * np.array([step, step, turn]) ** 2)
        return np.where(std > 0.0, grown, 0.0)

    def _close(self, vain: np.ndarray) -> None:
        """The choice is done with; ``vain`` ``(n, 2)``, m, is what is unknown still: not to be seen from there."""
        if len(vain):
            self._dismissed.append(vain)
        self._choice, self._arrived = None, True

    def _give_up(self) -> None:
        """The robot does not get to where it wanted to."""
        choice = self._choice
        parts = [] if choice is None else [a.reshape(-1, 2) for a in (choice.goal, choice.target) if a is not None]
        self._close(np.concatenate(parts) if parts else np.empty((0, 2)))

    def _command(self, planar: np.ndarray, near: ClearanceMap) -> tuple[np.ndarray, str]:
        """One step along the path, or one turn towards the next look."""
        limits = self._context.limits
        choice = self._choice
        if choice is None:  # no way after all
            return np.array([limits[0], 0.0, 0.0]), self._failed
        if self._path is not None:
            command = steer(planar, self._path, limits)
            if command[2] > 0.0:
                command = self._careful(planar, command, near)
            if np.any(command != 0.0):
                self._failures = 0 if command[2] > 0.0 else self._failures
                return command, choice.status
            self._held_up(planar, near)
            return np.array([limits[0], 0.0, 0.0]), "held up"
        if not choice.looks:
            return np.array(STOP_COMMAND), choice.status
        turn = float(np.clip(wrap_angle(choice.looks[0] - planar[2]), -limits[0], limits[0]))
        return np.array([turn, 0.0, 0.0]), choice.status

    def _held_up(self, planar: np.ndarray, near: ClearanceMap) -> None:
        """No step may be taken along the path: make room for another way, or choose anew from here."""
        self._failures += 1
        if math.hypot(*(planar[:2] - self._held)) > HELD:
            self._held, self._refused = planar[:2].copy(), 0
        self._refused += 1
        if self._refused % TRIES == 0:
            self._give_up()
        turns = np.arange(16) * math.pi / 8.0
        away = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        have = np.stack([near.at(planar[:2] + step * away) for step in (0.05, 0.1, HELD_STEP)])
        have[:, have.min(axis=0) < float(near.at(planar[:2]))] = -math.inf
        best = int(np.argmax(have[-1]))
        self._choice = self._path = None
        if math.isfinite(have[-1, best]):
            spot = planar[:2] + HELD_STEP * away[best]
            self._choice, self._path = Choice(spot, (), None, "makes room"), np.stack([planar[:2], spot])
            self._age = -HELD_STEPS

    def _followed(self, planar: np.ndarray) -> np.ndarray | None:
        """The path from where the robot is now; None where no part of it is in sight."""
        assert self._path is not None and self._roadmap is not None
        end = self._path[-1]
        points = np.concatenate([planar[None, :2], self._path[1:]])
        # Never less than a step keeps, or the path would be pulled to where no step may go.
        margin = max(self._margin - 0.015, self._config.guard)
        need = needed(self._roadmap.clearance, planar[:2], self._radius + margin)
        return tighten(self._roadmap.clearance, points, end, 0.0, need)

    def _careful(self, planar: np.ndarray, command: np.ndarray, near: ClearanceMap) -> np.ndarray:
        """The command with its step shortened so that the noise will not carry the body into anything."""
        c, (turn_std, step_std) = self._config, self._context.noise
        # Held up again and again, it dares more: what the noise does with small probability only.
        sigmas = c.sigmas * c.daring**self._failures
        direction = planar[2] + command[1]
        unit = np.array([math.cos(direction), math.sin(direction)])
        spread = math.sin(min(sigmas * turn_std, 0.5 * math.pi))
        far = sigmas * step_std
        t = np.arange(0.01, float(command[2]) + far + 0.005, 0.01)
        asked = self._radius + np.minimum(c.guard + spread * np.maximum(t - far, 0.0), c.held_share * self._margin)
        # A robot that is too near already may go along what it is near to.
        have, here = near.at(planar[:2] + t[:, None] * unit), float(near.at(planar[:2]))
        bad = np.flatnonzero(have < np.minimum(asked, here - 0.004))
        if len(bad) == 0:
            return command
        step = float(t[bad[0]]) - 0.01 - far
        return np.array([0.0, command[1], step]) if step >= LEAST_STEP else np.zeros(3)

    @property
    def _radius(self) -> float:
        return 0.5 * self._context.body_length


def points_along(path: Sequence[np.ndarray] | np.ndarray, length: float, spacing: float = 0.05) -> np.ndarray:
    """Points every ``spacing`` m of a polyline ``(n, 2)``, from its start to ``length`` m on; ``(k, 2)``."""
    path = np.asarray(path)
    edges = np.hypot(*np.diff(path, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(edges)])
    s = np.arange(0.0, min(length, along[-1]) + 1e-9, spacing)
    return np.stack([np.interp(s, along, path[:, a]) for a in (0, 1)], axis=1)
