"""Navigate to a goal: localise, look where to drive, plan, step with care, respond to failures, decide when to stop.

The navigating agents share this navigator. They differ in how they localise and in their
:class:`~vssm_gym.agents.shared.surroundings.Surroundings`: a map that they were given, or one that they build. The
planner is any of :mod:`vssm_gym.planning.planners`, A* by default. Every step shortens what is left of the path from
the newest estimate. The planner runs again where that fails, and where a place has changed through which a path could
lead that costs less: ``|robot - place| + |place - goal| < cost of the path``. A robot whose estimate is not believed
never arrives (:mod:`vssm_gym.agents.shared.trust`). What it does about failures is a table
(:mod:`vssm_gym.agents.shared.recovery`).
"""

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.shared.following import Follower, FollowingConfig, PlannedPath, points_along
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.manoeuvres import Manoeuvre, Nothing, Turn, around, back_off, retraced
from vssm_gym.agents.shared.progress import Progress
from vssm_gym.agents.shared.recovery import IN_KNOWN_MAP, Failure, Recovery, Response, Table
from vssm_gym.agents.shared.route import cost, first_found, may_improve, shortened
from vssm_gym.agents.shared.surroundings import Surroundings, Terrain
from vssm_gym.agents.shared.trust import Conduct, LostConfig, gave_up
from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.frontier import frontiers
from vssm_gym.planning.planners import Planner, find_planner
from vssm_gym.planning.pursuit import direction_of_travel, steer
from vssm_gym.planning.result import PlanResult, PlanStatus


@dataclass(frozen=True)
class NavigationConfig:
    """Configure how to plan, when to stop, and when something has failed; lengths in metres."""

    planner: str | Planner = "astar"  # a name of vssm_gym.planning.planners, or any planner
    # Clearance beyond the radius that a path must have, tried in turn; less than none, because surfaces have an error.
    margins: tuple[float, ...] = (0.01, -0.03)
    slack: float = 0.015  # by which following requires less than planning, so that small errors cause no new plan
    gain: float = 0.03  # share of its cost by which a new path must be cheaper to replace one that is still free
    stop_margin: float = 0.01  # inside the success radius, for errors that the estimate's covariance leaves out
    stop_sigmas: float = 2.5  # further inside, in standard deviations of the estimated position
    least_radius: float = 0.05  # the robot stops so near to the goal, however uncertain its estimate is
    landing: float = 0.002  # the path ends so far inside the stop radius; a step that ended short would cost another
    arrival: float = 0.1  # distance at which the goal of a detour is reached
    stuck_length: float = 0.4  # length of driving commands over which progress is measured
    stuck_share: float = 0.35  # fraction of it that the estimate must have moved; less means that the robot is stuck
    patience: int = 24  # steps within ``arrival`` of one place, while driving, after which it is stuck, too: 1.5 turns
    # Of the obstacle that is then assumed at the robot's front; it doubles with every time within a reach.
    obstacle_radius: float = 0.03
    obstacle_reach: float = 0.6
    largest_obstacle: float = 0.24
    # Of the obstacle that is assumed where an image has no depth: it is nearer than a depth camera measures.
    blind_distance: float = 0.3
    blind_radius: float = 0.14
    doubted: float = 1.5  # radius within which obstacles are doubted
    most_uncertain: tuple[float, float] = (0.15, 0.15)  # m, rad: standard deviations against the map
    look_first: bool = False  # whether an episode begins with a full turn
    # A bend nearer than the estimate errs would turn the robot back and forth; the test of the step keeps it safe.
    following: FollowingConfig = field(default_factory=lambda: FollowingConfig(bend_passed=0.08))
    lost: LostConfig = field(default_factory=LostConfig)  # when an estimate that is not believed fails the task
    responses: Table = field(default_factory=lambda: IN_KNOWN_MAP)


@dataclass
class _Task:
    """Hold what the navigator remembers about the present goal."""

    goal: np.ndarray
    recovery: Recovery
    path: PlannedPath | None = None
    rim: float = 0.0  # m, radius of the goal region where the plan could not lead to a safer one
    detour: np.ndarray | None = None  # (2,) m, a frontier's place to drive to before the goal
    facing: float = 0.0  # rad, heading to look in at the detour's end
    seen: list[np.ndarray] = field(default_factory=list)  # (n, 2) cells of frontiers that were driven to
    exact: bool = False  # whether the path's next bend is taken, however near it is
    progress: Progress = field(default_factory=Progress)
    held: list[np.ndarray] = field(default_factory=list)  # (2,) m, places where something held the robot


class Navigator:
    """Drive to ``observation["goal"]`` through its surroundings, then stop."""

    def __init__(self, surroundings: Surroundings, config: NavigationConfig) -> None:
        self.surroundings, self._config = surroundings, config
        self._plan = find_planner(config.planner)
        self.terrain: Terrain | None = None  # as it was last looked at

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing.

        A plan is made and dropped: the latencies include the first step's plan and no compilation.
        """
        self._context, self._follower = context, Follower.of(context, self._config.following)
        estimate = self.surroundings.reset(context, observation)
        self._open(estimate, observation)
        self._task.recovery.end()  # a look around comes before the first plan
        self._decide(estimate)
        self._open(self.surroundings.reset(context, observation), observation)

    def _open(self, estimate: Localization, observation: Observation) -> None:
        self._estimate = estimate
        self._command: np.ndarray | None = None
        self._track = [estimate.planar.copy()]  # poses that were believed
        self._begin(observation["goal"])
        if self._config.look_first:
            self._task.recovery.manoeuvre = around(float(estimate.planar[2]), self._most_turn)

    def act(self, observation: Observation) -> Decision:
        """Return the next action from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if self._command is not None:
            self._estimate = self.surroundings.update(self._command, observation)
        tracked = time.perf_counter()
        if not np.array_equal(observation["goal"], self._task.goal):
            self._begin(observation["goal"])
        return self._decision({"tracking": tracked - began})

    def redirected(self, goal: np.ndarray) -> Decision:
        """Return the decision for another goal ``(2,)``, m, in place of that of the last `act`."""
        self._begin(goal)
        return self._decision({})

    def _decision(self, latency: dict[str, float]) -> Decision:
        """Decide, remember the command, and add the time that it took."""
        began, estimate = time.perf_counter(), self._estimate
        activity, stop, command = self._decide(estimate)
        self._remember(estimate, command)
        latency = {**latency, "planning": time.perf_counter() - began}
        action = np.array([*command, float(stop)], np.float32)
        status = f"{activity}; localization: {estimate.status}"
        path = None if self._task.path is None else self._task.path.path
        gives_up = activity.startswith("gave up")
        counts = dict(self._task.recovery.counts)
        return Decision(action, estimate.planar.copy(), status, latency, path, gives_up, estimate.covariance, counts)

    def instead(self, command: np.ndarray) -> None:
        """Take ``command`` for that of the last decision: an agent had the robot do this and not what was decided."""
        self._remember(self._estimate, command)

    @property
    def estimate(self) -> Localization:
        """Return the belief over the pose at the last decision."""
        return self._estimate

    def _begin(self, goal: np.ndarray) -> None:
        """Begin a task with no plan."""
        self._task = _Task(np.array(goal, np.float64), Recovery(self._config.responses))

    def _decide(self, estimate: Localization) -> tuple[str, bool, np.ndarray]:
        """Return the activity, True to stop, and the command."""
        task, c, still, lost = self._task, self._config, np.array(STOP_COMMAND), bool(estimate.lost)
        match c.lost.conduct(estimate.lost, estimate.status):
            case Conduct.GIVE_UP:
                return gave_up(estimate.lost), True, still
            case Conduct.WAIT:
                return "waiting: lost", False, still
            case Conduct.SEARCH:
                return self._search(estimate)
        if not lost:
            self._believe(estimate)
            if task.recovery.of is Failure.LOST:
                task.recovery.found()
        if (command := task.recovery.manoeuvre.command(estimate.planar)) is not None:
            task.progress.forget()
            return task.recovery.activity, False, command
        task.recovery.end()
        distance = math.hypot(*(estimate.planar[:2] - task.goal))
        if distance <= self._stop_radius(estimate):
            return ("looking around: lost", False, self._turn()) if lost else ("arrived", True, still)
        held = task.progress.is_held(estimate.planar, c.stuck_length, c.stuck_share)
        dithers = task.progress.dithers(estimate.planar, c.arrival, c.patience)
        if held:
            task.recovery.counts[HELD] += 1
            radius = self._assumed_radius(estimate)
            self._meet_obstacle(estimate, self._command, self._radius + radius, radius)
        if dithers and (response := self._respond(Failure.STUCK, estimate)) is not None:
            return response
        if not lost and self._is_uncertain(estimate) and (response := self._respond(Failure.UNCERTAIN, estimate)):
            return response
        terrain = self.terrain = self.surroundings.look(estimate.planar, task.goal)
        failure = self._follow(estimate, terrain)
        if failure is not None:
            full = f"; {NO_ROOM}" if self.surroundings.is_full else ""
            response = self._respond(Failure.NO_PATH, estimate, f"{failure.status.message}{full}")
            return response or ("looking around: no path", False, self._turn())
        assert task.path is not None
        if task.detour is None and distance <= task.rim + self._config.landing:
            return ("looking around: lost", False, self._turn()) if lost else (NEAREST, True, still)
        if task.detour is not None and math.hypot(*(task.detour - estimate.planar[:2])) <= self._config.arrival:
            return self._look_from_detour(estimate)
        command = self._step(estimate, terrain, task.path)
        if command[2] > 0.0 and not self.surroundings.sees_ahead():
            task.recovery.counts[BLIND] += 1
            self._meet_obstacle(estimate, command, c.blind_distance, c.blind_radius)
            return f"looking around: {BLIND}", False, still
        if not np.any(command):
            response = self._respond(Failure.BLOCKED, estimate)
            return response or ("looking around: blocked", False, self._turn())
        return "driving" if task.detour is None else "exploring", False, command

    # --- the path

    def _stop_radius(self, estimate: Localization) -> float:
        """Return the distance to the goal (m) at which a stop is safe for the uncertainty of the estimate."""
        c, spread = self._config, float(np.max(estimate.std[:2]))
        if estimate.covariance is not None:
            spread = math.sqrt(max(0.0, float(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1])))
        return max(c.least_radius, self._context.success_radius - c.stop_margin - c.stop_sigmas * spread)

    def _follow(self, estimate: Localization, terrain: Terrain) -> PlanResult | None:
        """Update the task's path; return None, or the planner's last result where there is no path."""
        task, c = self._task, self._config
        target = self._stop_radius(estimate) - c.landing
        end, radius = (task.goal, max(target, task.rim)) if task.detour is None else (task.detour, 0.0)
        planar, body, kept = estimate.planar, self._radius, None
        if task.path is not None:
            kept = shortened(task.path, planar, terrain.space, end, radius, body - c.slack)
        if kept is not None:
            # A detour is driven because no path led to the goal: whatever has changed may open one.
            detour = task.detour is not None and len(terrain.changed) > 0
            if not (detour or may_improve(terrain.changed, kept, planar, end)):
                task.path = kept
                return None
        largest = self._context.success_radius - 2.0 * c.landing
        attempts = [(radius, margin) for radius in (target, largest) for margin in c.margins]
        result, reached, margin = first_found(self._plan, planar, task.goal, terrain.space, body, attempts)
        if result.found:
            found, rim = PlannedPath(result.path, terrain.space, margin), largest if reached > target else 0.0
            if kept is None or task.detour is not None or result.cost < (1.0 - c.gain) * cost(kept):
                task.path, task.rim, task.detour = found, rim, None
            else:
                task.path = kept
            return None
        if kept is not None:  # of a detour
            task.path = kept
            return None
        task.path, task.detour = None, None
        return result

    def _step(self, estimate: Localization, terrain: Terrain, planned: PlannedPath) -> np.ndarray:
        """Return the next command along the path, at the least risk at which the robot moves; zeros where none is."""
        # The path's margin is what it has here: a narrow place elsewhere asks for no care now.
        ahead = points_along(planned.path, self._config.following.lookahead)
        margin = float(np.min(terrain.near.at(ahead))) - self._radius
        planned = replace(planned, margin=max(planned.margin, margin))
        # In the end it is enough that the step is free where it is executed as commanded, and to take each bend.
        task = self._task
        for exact in (True,) if task.exact else (False, True):
            task.exact = exact
            for failures in (*range(self._config.following.tries + 2), math.inf):
                command = self._follower.step(planned, estimate.planar, terrain.near, failures, estimate.std, exact)
                if np.any(command):
                    task.exact &= command[2] == 0.0  # a turn towards a bend is completed
                    return command
        if terrain.plan is not None:  # the step may lead where nothing is known
            return np.zeros(3)
        return steer(estimate.planar, planned.path, self._context.limits, self._context.direction_frame)

    # --- failures

    def _respond(self, failure: Failure, estimate: Localization, why: str = "") -> tuple[str, bool, np.ndarray] | None:
        """Begin the next response to a failure; return its first command, a stop where there is none left, or None.

        None: the response has changed the plan, or there is nothing to be done but to go on.
        """
        recovery = self._task.recovery
        while (response := recovery.response(failure, estimate.planar)) is not None:
            manoeuvre = self._manoeuvre(response, estimate)
            if manoeuvre is None:
                continue
            recovery.counts[response.value] += 1
            command = manoeuvre.command(estimate.planar)
            if command is None:
                return None
            recovery.begin(failure, response, manoeuvre)
            return recovery.activity, False, command
        if failure in (Failure.UNCERTAIN, Failure.LOST):
            return None
        return f"gave up: {why or failure.value}", True, np.array(STOP_COMMAND)

    def _manoeuvre(self, response: Response, estimate: Localization) -> Manoeuvre | None:
        """Return what a response makes the robot do; None where it cannot be done."""
        planar, c = estimate.planar, self._config
        match response:
            case Response.LOOK_BACK:
                return Turn([float(self._known_view(planar)[2])], self._most_turn)
            case Response.TURN_AROUND:
                return around(float(planar[2]), self._most_turn)
            case Response.RETRACE:
                return retraced(self._track, planar, self._context)
            case Response.BACK_OFF:
                self._task.path = None
                near = self.surroundings.around(planar)
                return back_off(planar, near, c.following.retreat, self._context) or Nothing()
            case Response.LOOK_AGAIN:
                if not self.surroundings.doubt(planar[:2], c.doubted):
                    return None
                self._task.path = None
                return around(float(planar[2]), self._most_turn)
            case Response.EXPLORE:
                return Nothing() if self._detour(estimate) else None
            case Response.GO_ON:
                return Nothing()

    def _search(self, estimate: Localization) -> tuple[str, bool, np.ndarray]:
        """Look for an image that fits."""
        recovery = self._task.recovery
        if recovery.of is Failure.LOST:
            command = recovery.manoeuvre.command(estimate.planar)
            if command is not None:
                return recovery.activity, False, command
        response = self._respond(Failure.LOST, estimate)
        return response or ("looking around: lost", False, self._turn())

    def _detour(self, estimate: Localization) -> bool:
        """Plan to the frontier that is nearest on the way to the goal; return True where there is one."""
        task, c = self._task, self._config
        terrain = self.terrain
        if terrain is None or terrain.plan is None:
            return False
        roadmap = Roadmap.of(terrain.plan, estimate.planar[:2], self._radius + c.margins[0])
        seen = np.concatenate(task.seen) if task.seen else np.empty((0, 2))
        found = frontiers(terrain.plan, roadmap.distance, dismissed=seen)
        for frontier in sorted(found, key=lambda f: f.distance + math.hypot(*(f.goal - task.goal))):
            for margin in c.margins:
                result = self._plan(
                    estimate.planar, frontier.goal, roadmap.clearance, self._radius, margin=margin, goal_radius=0.0
                )
                if result.status is PlanStatus.FOUND:
                    dx, dy = frontier.xy.mean(axis=0) - frontier.goal
                    task.path, task.rim = PlannedPath(result.path, terrain.space, margin), 0.0
                    task.detour, task.facing = frontier.goal, math.atan2(dy, dx)
                    task.seen.append(frontier.xy)
                    return True
        return False

    def _look_from_detour(self, estimate: Localization) -> tuple[str, bool, np.ndarray]:
        """Turn to the frontier that was driven to; the plan to the goal is made anew then."""
        task = self._task
        task.detour, task.path = None, None
        task.recovery.overcome(Failure.NO_PATH)
        turn = Turn([task.facing, *around(task.facing, self._most_turn).headings], self._most_turn)
        task.recovery.begin(Failure.NO_PATH, Response.EXPLORE, turn)
        command = turn.command(estimate.planar)
        return task.recovery.activity, False, self._turn() if command is None else command

    def _is_uncertain(self, estimate: Localization) -> bool:
        place, heading = self._config.most_uncertain
        return bool(np.max(estimate.std[:2]) > place or estimate.std[2] > heading)

    def _assumed_radius(self, estimate: Localization) -> float:
        """Return the radius of the obstacle that holds the robot, m: twice as large each time that it did here."""
        task, c = self._task, self._config
        before = sum(math.hypot(*(estimate.planar[:2] - place)) < c.obstacle_reach for place in task.held)
        task.held.append(estimate.planar[:2].copy())
        return min(c.obstacle_radius * 2.0**before, c.largest_obstacle)

    def _meet_obstacle(self, estimate: Localization, command: np.ndarray | None, front: float, radius: float) -> None:
        """Assume an obstacle ``front`` m along a command, of ``radius`` m, and plan a path around it."""
        command = np.zeros(3) if command is None else command
        heading = direction_of_travel(estimate.planar, command, self._context.direction_frame)
        centre = estimate.planar[:2] + front * np.array([math.cos(heading), math.sin(heading)])
        self.surroundings.meet(centre, radius)
        self._task.path = None
        self._task.progress.forget()

    # --- memory

    @property
    def _radius(self) -> float:
        return 0.5 * self._context.body_length

    @property
    def _most_turn(self) -> float:
        return float(self._context.limits[0])

    def _turn(self) -> np.ndarray:
        return np.array([self._most_turn, 0.0, 0.0])

    def _remember(self, estimate: Localization, command: np.ndarray) -> None:
        self._command = np.asarray(command, np.float32)
        self._task.progress.sent(float(command[2]), estimate.planar)

    def _believe(self, estimate: Localization) -> None:
        """Remember a pose that is believed, where it is another one."""
        moved = estimate.planar - self._track[-1]
        if math.hypot(*moved[:2]) > 0.1 or abs(moved[2]) > 0.2:
            self._track.append(estimate.planar.copy())

    def _known_view(self, planar: np.ndarray) -> np.ndarray:
        """Return the believed pose nearest to here, the latest of several."""
        track = np.array(self._track)
        away = np.hypot(*(track[:, :2] - planar[:2]).T)
        return track[np.flatnonzero(away <= away.min() + 0.1)[-1]]


NO_ROOM = "its map is full"
NEAREST = "arrived as near as a path leads"
HELD = "plans around what holds it"  # where the robot does not move as commanded
BLIND = "does not drive blindly"  # where an image shows nothing ahead
