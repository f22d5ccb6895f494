"""Navigate to a goal: localise, look where to drive, plan, step with care, respond to failures, decide when to stop.

The navigating agents share this navigator. They differ in how they localise and in their
:class:`~vssm_gym.agents.shared.surroundings.Surroundings`: a map that they were given, or one that they build. The
path is kept by a :class:`~vssm_gym.agents.shared.route.Route`. A robot whose estimate is not believed never arrives
(:mod:`vssm_gym.agents.shared.trust`). What it does about failures is a table (:mod:`vssm_gym.agents.shared.recovery`).
"""

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.shared.following import Follower, PlannedPath, points_along
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.manoeuvres import Manoeuvre, Nothing, Turn, around, back_off, retraced
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.pose_track import PoseTrack
from vssm_gym.agents.shared.progress import Progress
from vssm_gym.agents.shared.recovery import Failure, Recovery, Response
from vssm_gym.agents.shared.route import Route
from vssm_gym.agents.shared.surroundings import Surroundings, Terrain
from vssm_gym.agents.shared.trust import Conduct, gave_up
from vssm_gym.planning.planners import find_planner
from vssm_gym.planning.pursuit import direction_of_travel, steer

RISKS = (*range(6), math.inf)  # powers of ``FollowingConfig.daring``, tried in turn: the noise counts less each time


@dataclass
class _Task:
    """Hold what the navigator remembers about the present goal."""

    route: Route
    recovery: Recovery
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
        self._track = PoseTrack([estimate.planar.copy()])
        self._begin(observation["goal"])
        if self._config.look_first:
            self._task.recovery.manoeuvre = around(float(estimate.planar[2]), self._most_turn)

    def act(self, observation: Observation) -> Decision:
        """Return the next action from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if self._command is not None:
            self._estimate = self.surroundings.update(self._command, observation)
        tracked = time.perf_counter()
        if not np.array_equal(observation["goal"], self._task.route.goal):
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
        path = None if self._task.route.path is None else self._task.route.path.path
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
        goal, c, robot = np.array(goal, np.float64), self._config, self._context
        self._task = _Task(Route(goal, self._radius, robot.success_radius, c, self._plan), Recovery(c.responses))

    def _decide(self, estimate: Localization) -> tuple[str, bool, np.ndarray]:
        """Return the activity, True to stop, and the command."""
        task, c, still, lost = self._task, self._config, np.array(STOP_COMMAND), bool(estimate.lost)
        route = task.route
        match c.lost.conduct(estimate.lost, estimate.status):
            case Conduct.GIVE_UP:
                return gave_up(estimate.lost), True, still
            case Conduct.WAIT:
                return "waiting: lost", False, still
            case Conduct.SEARCH:
                return self._search(estimate)
        if not lost:
            self._track.add(estimate.planar)
            if task.recovery.of is Failure.LOST:
                task.recovery.found()
        if (command := task.recovery.manoeuvre.command(estimate.planar)) is not None:
            task.progress.forget()
            return task.recovery.activity, False, command
        task.recovery.end()
        distance = math.hypot(*(estimate.planar[:2] - route.goal))
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
        terrain = self.terrain = self.surroundings.look(estimate.planar, route.goal)
        failure = route.update(estimate.planar, terrain, self._stop_radius(estimate))
        if failure is not None:
            full = f"; {NO_ROOM}" if self.surroundings.is_full else ""
            response = self._respond(Failure.NO_PATH, estimate, f"{failure.status.message}{full}")
            return response or ("looking around: no path", False, self._turn())
        assert route.path is not None
        if route.detour is None and distance <= route.rim + c.landing:
            return ("looking around: lost", False, self._turn()) if lost else (NEAREST, True, still)
        if route.detour is not None and math.hypot(*(route.detour.end - estimate.planar[:2])) <= c.arrival:
            return self._look_at_frontier(estimate)
        command = self._step(estimate, terrain, route.path)
        if command[2] > 0.0 and not self.surroundings.sees_ahead():
            task.recovery.counts[BLIND] += 1
            self._meet_obstacle(estimate, command, c.blind_distance, c.blind_radius)
            task.progress.blind += 1
            if task.progress.blind > c.patience:
                task.progress.blind = 0
                if (response := self._respond(Failure.STUCK, estimate)) is not None:
                    return response
            return f"looking around: {BLIND}", False, still
        if not np.any(command):
            response = self._respond(Failure.BLOCKED, estimate)
            return response or ("looking around: blocked", False, self._turn())
        return "driving" if route.detour is None else "exploring", False, command

    # --- the path

    def _stop_radius(self, estimate: Localization) -> float:
        """Return the distance to the goal (m) at which a stop is safe for the uncertainty of the estimate."""
        c, spread = self._config, float(np.max(estimate.std[:2]))
        if estimate.covariance is not None:
            spread = math.sqrt(max(0.0, float(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1])))
        return max(c.least_radius, self._context.success_radius - c.stop_margin - c.stop_sigmas * spread)

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
            for failures in RISKS:
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
                return Turn([float(self._track.nearest(planar)[2])], self._most_turn)
            case Response.TURN_AROUND:
                return around(float(planar[2]), self._most_turn)
            case Response.RETRACE:
                return retraced(self._track.poses, planar, self._context)
            case Response.BACK_OFF:
                self._task.route.path = None
                near = self.surroundings.around(planar)
                return back_off(planar, near, c.following.retreat, self._context) or Nothing()
            case Response.LOOK_AGAIN:
                if not self.surroundings.doubt(planar[:2], c.doubted):
                    return None
                self._task.route.path = None
                return around(float(planar[2]), self._most_turn)
            case Response.EXPLORE:
                found = self.terrain is not None and self._task.route.explore(planar, self.terrain)
                return Nothing() if found else None
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

    def _look_at_frontier(self, estimate: Localization) -> tuple[str, bool, np.ndarray]:
        """Turn to the frontier that was driven to; the plan to the goal is made anew then."""
        recovery, facing = self._task.recovery, self._task.route.end_detour()
        recovery.overcome(Failure.NO_PATH)
        turn = Turn([facing, *around(facing, self._most_turn).headings], self._most_turn)
        recovery.begin(Failure.NO_PATH, Response.EXPLORE, turn)
        command = turn.command(estimate.planar)
        return recovery.activity, False, self._turn() if command is None else command

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
        self._task.route.path = None
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


NO_ROOM = "its map is full"
NEAREST = "arrived as near as a path leads"
HELD = "plans around what holds it"  # where the robot does not move as commanded
BLIND = "does not drive blindly"  # where an image shows nothing ahead
