"""Drive a car to its target: localise, plan on the learned map, command.

The car's agents share this driver and differ in their localizer and their :class:`CarController`. The map is static, so
its floor plan is made once per map. A target that no path leads to is refused before the car moves. Without an estimate
that may be believed, the car drives on by its commands for a while, then brakes, and gives up in the end
(:class:`~vssm_gym.agents.shared.trust.LostConfig`). Where the episode ends on the agent's stop, the car parks and stops
by its belief (:class:`~vssm_gym.agents.shared.car.parking.ParkingRule`).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.car.parking import Parking, ParkingRule, braking
from vssm_gym.agents.shared.localization import Localizer
from vssm_gym.agents.shared.trust import Conduct, LostConfig, gave_up
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.car.footprint import Arena, arena_from_map

LOST_RULE = LostConfig()  # what to do without an estimate that may be believed
SURFACE_ERROR = 0.01  # m around the footprint that controllers keep free, because learned surfaces have an error


@dataclass(frozen=True)
class CarCommand:
    """Hold what a controller does now.

    Attributes:
        control: ``(2,)`` speed (m/s) and steering (rad).
        status: one readable line.
        plan: ``(n, 2)`` positions of the rear axle still to be driven, m; None without a plan.
    """

    control: np.ndarray
    status: str
    plan: np.ndarray | None = None


class CarController(Protocol):
    """Control a car to targets in one floor plan."""

    def begin(self, planar: np.ndarray, goal: np.ndarray, control: np.ndarray) -> str | None:
        """Take a new target, ``(x, y)`` or ``(x, y, heading)``; return the reason where no path leads there, else None.

        ``control`` is what the car executes as the target changes: it may be moving.
        """
        ...

    def step(self, planar: np.ndarray) -> CarCommand:
        """Return the command of this step, from the newest estimate ``(x, y, heading)``."""
        ...


class Driver:
    """Drive to ``observation["goal"]`` by the pose that a localizer estimates.

    Args:
        localizer: estimates the pose.
        make: returns a controller for a floor plan and a car.
    """

    def __init__(self, localizer: Localizer, make: Callable[[Arena, Car], CarController]) -> None:
        self._localizer, self._make = localizer, make
        self._map: VoxelMap | None = None
        self._controller: CarController  # for that map, kept over episodes

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; a controller seeds its own random draws, so ``seed`` changes nothing."""
        if context.map is None or context.car is None:
            missing = "map" if context.map is None else "car"
            raise InputError("AgentContext", missing, "a learned map and a car: this agent plans a car's path in a map")
        if context.map is not self._map:
            arena = arena_from_map(context.map)
            self._controller, self._map = self._make(arena, context.car), context.map
        self._car, self._stops = context.car, context.stops
        self._command = np.zeros(2)
        self._fresh = True
        self._estimate = self._localizer.reset(context, observation)
        self._begin(observation["goal"])
        if self._refused is None:  # compiled here, so that no step's latency holds it
            self._controller.step(self._estimate.planar)
            self._begin(observation["goal"])

    def act(self, observation: Observation) -> Decision:
        """Return the next command from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if not self._fresh:
            self._estimate = self._localizer.update(self._command, observation)
        self._fresh = False
        tracked = time.perf_counter()
        if not np.array_equal(observation["goal"], self._goal):
            self._begin(observation["goal"])
        planned = time.perf_counter()
        lost, gives_up = self._estimate.lost, self._refused is not None
        conduct = LOST_RULE.conduct(lost, self._estimate.status)
        parking = self._parking.step(self._estimate, self._command) if self._stops and not lost else Parking.DRIVE
        if self._refused is not None:
            step = CarCommand(np.zeros(2), self._refused)
        elif conduct is Conduct.GIVE_UP:
            step, gives_up = CarCommand(np.zeros(2), gave_up(lost)), True
        elif conduct in (Conduct.SEARCH, Conduct.WAIT):  # a car cannot look around without driving
            step = CarCommand(np.zeros(2), "waiting: lost")
        elif parking is not Parking.DRIVE:
            step = CarCommand(braking(self._command, self._car), parking.value)
        else:
            step = self._controller.step(self._estimate.planar)
        self._command = self._car.clip(step.control)
        ended = time.perf_counter()
        latency = {"tracking": tracked - began, "planning": planned - tracked, "control": ended - planned}
        status = f"{step.status}; localization: {self._estimate.status}"
        stop = [float(parking in (Parking.STOP, Parking.TRUST))] if self._stops else []
        action = np.array([*self._command, *stop], np.float32)
        pose = self._estimate.planar.copy()
        return Decision(action, pose, status, latency, step.plan, gives_up, self._estimate.covariance)

    def _begin(self, goal: np.ndarray) -> None:
        self._goal = np.array(goal)
        self._parking = ParkingRule(self._car, self._goal)
        goal = self._goal.astype(np.float64)
        self._refused = self._controller.begin(self._estimate.planar, goal, self._command)
