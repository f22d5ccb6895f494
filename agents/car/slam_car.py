"""Park a car without a map: estimate pose and map from RGB-D, plan on the map as it grows.

PRISM with the car's bicycle estimates the pose and a block-sparse map that is empty at first. Value iteration on its
growing floor plan is the critic, unknown space being passable at a price; the model-predictive control of ``vi_mpc`` is
the actor, which keeps off unknown space. Where the route leads onto what the camera would not show in time, the car
drives first to a pose from which it sees it. It stops where its belief says that it has arrived. What it does when it
is lost, stuck or without a path is a table (:mod:`vssm_gym.agents.shared.car.recovery`). Described in
``docs/agents/car.md``.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.car.vi_mpc import PROBLEM, SafeMpc
from vssm_gym.agents.shared.car.driver import CarCommand
from vssm_gym.agents.shared.car.growing_critic import GrowingConfig, GrowingCritic
from vssm_gym.agents.shared.car.lead import Leader
from vssm_gym.agents.shared.car.parking import Parking, ParkingRule, braking
from vssm_gym.agents.shared.car.progress import Progress, Stuck, StuckConfig
from vssm_gym.agents.shared.car.recovery import CREEP_SPEED, Failure, Recovery, Response, Trail, creeping, leads_into
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.agents.shared.own_map import OwnMap, OwnMapConfig
from vssm_gym.agents.shared.trust import LostConfig, gave_up
from vssm_gym.errors import InputError
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.car.footprint import CAR_HEIGHTS, Arena
from vssm_gym.planning.mpc.random_search import RandomSearch
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED

# Cells of 4 cm: a bay of 0.42 m holds a car with 3 cm on either side. The ring and the actor's border of one cell, less
# its margin, are the 5 cm that a start keeps from everything.
CAR_MAP = OwnMapConfig(voxel=0.04, extent=24.0, levels=(-0.3, 2.7), heights=CAR_HEIGHTS, ring=0.03)
# Where it may drive only a little way it would put that off for ever: a plan that gets on earlier is cheaper.
HASTY = replace(PROBLEM, config=replace(PROBLEM.config, haste=0.05))
BY_STATUS = {  # of an estimate that is not believed
    Status.FROZEN: Failure.FROZEN,
    Status.REPEATED: Failure.REPEATED,
    Status.NO_READING: Failure.BLIND,
    Status.UNCONFIRMED: Failure.UNCONFIRMED,
}


@dataclass(frozen=True)
class SlamCarConfig:
    """Configure the map, the critic, and when the car counts as stuck.

    Args:
        map: cells and heights of the agent's own map.
        critic: its grid, the price of unknown space, and when it is computed again.
        stuck: when something holds the car.
        lost: when an estimate that is not believed fails the task; until then the responses of the table are tried.
        progress: motions by which the way that is left has to get shorter.
        unseen_steps: in a row that the controller drives without it, after which it may drive onto unseen space.
        held_steps: in a row that the controller drives without it: its plan leads nowhere.
    """

    map: OwnMapConfig = CAR_MAP
    critic: GrowingConfig = field(default_factory=GrowingConfig)
    stuck: StuckConfig = field(default_factory=StuckConfig)
    lost: LostConfig = field(default_factory=lambda: LostConfig(give_up=100))
    progress: float = 0.3
    unseen_steps: int = 12
    held_steps: int = 25


class SlamCarAgent:
    """Localise and map by PRISM; drive by value iteration and model-predictive control; stop by belief."""

    name = "slam_car"
    robot = "car"
    task = "pointgoal"
    needs_pose = False
    needs_map = False

    def __init__(self, config: SlamCarConfig | None = None) -> None:
        self._config = config or SlamCarConfig()
        self._mpc = SafeMpc(RandomSearch(HASTY))

    @property
    def map(self) -> VoxelMap:
        """Return the agent's own map, world frame up to its drift."""
        return self._own.map

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode with an empty map; ``seed`` changes nothing, because the solver seeds its own draws."""
        if context.car is None:
            raise InputError("AgentContext", "car", "a car: this agent plans a car's path")
        self._car, self._stops = context.car, context.stops
        self._own = OwnMap(context, MapAndPose(), self._config.map, observation)
        self._command, self._fresh = np.zeros(2), True
        self._retraces = False  # its last command undid a piece of its trail
        self._trail = Trail(self._car, self._own.estimate.planar)
        self._half_angle = float(np.arctan(0.5 * context.camera[0] / context.K[0, 0]))
        self._stuck = Stuck(self._config.stuck)
        self._begin(observation["goal"])
        at = self._own.estimate.planar
        self._critic.update(self._own.plan(), at)
        if self._critic.aim is not None:  # compiled here, so that no step's latency holds it
            self._mpc.step(at, self._critic.aim, self._critic.clearance())
        self._mpc.begin(np.zeros(2))

    def act(self, observation: Observation) -> Decision:
        """Return the next command from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if not self._fresh:
            self._own.take(self._command, observation)
        self._fresh = False
        at = self._own.estimate
        if self._retraces:
            self._trail.begin(at.planar)
        else:
            self._trail.drove(at.planar)
        self._retraces = False
        tracked = time.perf_counter()
        if not np.array_equal(observation["goal"], self._goal):
            self._begin(observation["goal"])
        if not at.lost:
            self._critic.update(self._own.plan(), at.planar)
        planned = time.perf_counter()
        response = self._recovery.step(self._failure(at))
        if at.lost > self._config.lost.give_up:
            response = Response.GIVE_UP
        parking = Parking.DRIVE
        if self._stops and not at.lost and response is not Response.GIVE_UP:
            parking = self._parking.step(at, self._command)
        step = self._respond(response, at) if parking is Parking.DRIVE else self._brake(parking.value)
        self._command = self._car.clip(step.control)
        stop = [float(parking in (Parking.STOP, Parking.TRUST))] if self._stops else []
        ended = time.perf_counter()
        return Decision(
            np.array([*self._command, *stop], np.float32),
            at.planar.copy(),
            f"{step.status}; localization: {at.status}",
            {"tracking": tracked - began, "planning": planned - tracked, "control": ended - planned},
            step.plan,
            response is Response.GIVE_UP,
            at.covariance,
            dict(self._recovery.counts),
        )

    def _begin(self, goal: np.ndarray) -> None:
        self._goal = np.array(goal)
        self._progress = Progress(self._config.progress)
        target = self._goal.astype(np.float64)
        self._critic = GrowingCritic(self._car, target, self._half_angle, self._config.critic)
        self._parking = ParkingRule(self._car, target)
        self._recovery = Recovery()
        self._mpc.begin(self._command)
        self._leader = Leader(self._car)

    def _failure(self, at: Localization) -> Failure | None:
        """Return what is wrong now, and note where the car was held."""
        if at.lost:
            self._stuck.clear()
            return BY_STATUS.get(at.status, Failure.LOST)
        c = self._config
        length = self._stuck.step(float(self._command[0]) * self._car.dt, at.planar[:2])
        if length is not None:
            self._own.bump(at.planar, length > 0.0)
            return Failure.STUCK
        if self._parking.waits:  # it is where its plan leads to
            self._progress.restart()
        if self._critic.aim is not None:
            self._progress.see(self._critic.computed, self._critic.motions(at.planar))
        if self._progress.steps == c.unseen_steps and self._critic.dare(at.planar):
            self._progress.restart()
            self._leader.failed(Failure.UNSEEN, self._critic.hesitates)
            return Failure.UNSEEN
        if self._progress.steps >= c.held_steps:
            self._progress.restart()
            self._critic.forget()
            self._leader.failed(Failure.HELD, self._critic.hesitates)
            return Failure.HELD
        return Failure.NO_PATH if self._critic.aim is None else None

    def _respond(self, response: Response, at: Localization) -> CarCommand:
        """Carry out a response; where nothing is wrong, the plan."""
        why = self._recovery.failure.value if self._recovery.failure else ""
        aim = self._critic.aim
        if response is not Response.DRIVE or aim is None:
            self._mpc.begin(self._command)
            self._progress.restart()
            self._leader.stop()
        if response is Response.GIVE_UP:
            return CarCommand(np.zeros(2), gave_up(at.lost) if at.lost else f"gave up: {why}")
        if response is Response.BACK_UP and (back := self._trail.back()) is not None:
            plan = self._own.plan()
            if at.lost or not leads_into(
                plan.cells == OCCUPIED, plan.origin, plan.resolution, at.planar, back, self._car
            ):
                self._trail.undo()
                self._retraces = True
                return CarCommand(back, f"{response.value}: {why}")
        if response is Response.CREEP:
            return CarCommand(creeping(self._known_free(), at.planar, self._car), f"{response.value}: {why}")
        if response is not Response.DRIVE or aim is None:
            return self._brake(f"brakes: {why}")
        self._progress.drove()
        if (led := self._leader.step(at.planar, self._own.plan, self._critic.lead)) is not None:
            self._mpc.begin(led)
            return CarCommand(led, "is led along its route")
        step = self._mpc.step(at.planar, aim, self._critic.clearance())
        if self._critic.careful(at.planar, step.control):
            step = replace(step, control=np.clip(step.control, [-CREEP_SPEED, -np.inf], [CREEP_SPEED, np.inf]))
        return step if not self._critic.looks else replace(step, status=f"looks first: {step.status}")

    def _brake(self, status: str) -> CarCommand:
        control = braking(self._command, self._car)
        self._mpc.begin(control)
        return CarCommand(control, status)

    def _known_free(self) -> Arena:
        """Return the floor plan in which unknown space is occupied, for motions without a plan."""
        plan = self._own.plan()
        return Arena.from_occupied(plan.cells != FREE, plan.origin, plan.resolution)
