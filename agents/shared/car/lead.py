"""Lead a car along a piece of its route by pure pursuit, where the controller finds no way to drive it.

The cost-to-go knows of a route what a short horizon of random commands may miss: three changes of gear in a gap of
centimetres, or the one arc that meets no other unseen cells than those it dares.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from vssm_gym.agents.shared.car.recovery import CREEP_SPEED, Failure, leads_into
from vssm_gym.geometry.arc import arc_between, poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import footprint_cells
from vssm_gym.planning.car.pursuit import CarPath, PursuitConfig
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import OCCUPIED

ROUTE_SPACING = 0.02  # m between the poses of the path
ASTRAY = 0.05  # m from the route, beyond which the car follows it no more
LED_REACH = 0.03  # m that have to be free where it is led: its route may turn back after that


class Lead:
    """Follow one route of poses ``(n, 3)``, n > 1, joined by arcs."""

    def __init__(self, route: np.ndarray, car: Car) -> None:
        poses, gears = [route[0]], [1.0]
        for start, end in pairwise(route):
            length, steering = arc_between(start, end, car.wheelbase)
            steering = float(np.clip(steering, -car.max_steering, car.max_steering))
            lengths = length * np.linspace(0.0, 1.0, int(np.ceil(abs(length) / ROUTE_SPACING)) + 1)[1:]
            poses += list(poses_after(start[2], lengths, turn_of(lengths, steering, car.wheelbase), *start[:2]))
            gears += [np.sign(length)] * len(lengths)
        gears[0] = gears[1]
        self._path = CarPath(np.array(poses), np.array(gears, int), PursuitConfig(setting_off=CREEP_SPEED))
        self._car, self._progress = car, 0.0

    def step(self, planar: np.ndarray) -> np.ndarray | None:
        """Return the command ``(speed, steering)`` at a pose; None at the route's end, or away from it."""
        command = self._path.follow(planar, self._progress, self._car)
        self._progress = command.progress
        if command.done or command.deviation > ASTRAY:
            return None
        return np.clip(command.control, [-CREEP_SPEED, -np.inf], [CREEP_SPEED, np.inf])


class Leader:
    """Decide when a car is led, and lead it: to one target of one car.

    It is led from the next step on where it hesitates before unseen space, or its plan has led nowhere twice.
    """

    def __init__(self, car: Car) -> None:
        self._car = car
        self._lead: Lead | None = None
        self._due = self._held = False  # to be led at the next step; its plan has led nowhere before

    def failed(self, failure: Failure, hesitates: bool) -> None:
        """Note that the car does not get on: before unseen space, or as its plan leads nowhere."""
        self.stop()
        if failure is Failure.UNSEEN:
            self._due = hesitates
        elif failure is Failure.HELD:
            self._due, self._held = self._held, True

    def stop(self) -> None:
        """End the present lead."""
        self._lead = None

    def step(
        self, planar: np.ndarray, plan: Callable[[], FloorPlan], route: Callable[[np.ndarray], np.ndarray | None]
    ) -> np.ndarray | None:
        """Return the command ``(speed, steering)``; None for a car that is not led, or whose way is not free.

        Args:
            planar: ``(3,)`` where the car is, m and rad.
            plan: reads it as it is known now; only for a car that is led.
            route: returns the poses to be driven from a pose on, or None.
        """
        if self._due:
            poses, self._due = route(planar), False
            self._lead = None if poses is None else Lead(poses, self._car)
        command = None if self._lead is None else self._lead.step(planar)
        if command is None or self._blocked(planar, plan(), command):
            self._lead = None
            return None
        return command

    def _blocked(self, planar: np.ndarray, plan: FloorPlan, command: np.ndarray) -> bool:
        """Return True where the command leads onto occupied cells that the car does not already touch."""
        occupied = plan.cells == OCCUPIED
        under = footprint_cells(plan.origin, plan.resolution, planar, self._car)
        under = under[np.all((under >= 0) & (under < occupied.shape), axis=1)]
        occupied[tuple(under.T)] = False
        return leads_into(occupied, plan.origin, plan.resolution, planar, command, self._car, LED_REACH)
