"""Lead a car along a piece of its route by pure pursuit, where the controller finds no way to drive it.

The cost-to-go knows of a route what a short horizon of random commands may miss: three changes of gear in a gap of
centimetres, or the one arc that meets no other unseen cells than those it dares.
"""

from itertools import pairwise

import numpy as np

from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car.pursuit import CarPath, PursuitConfig

SPEED = 0.15  # m/s, at most
ROUTE_SPACING = 0.02  # m between the poses of the path
ASTRAY = 0.05  # m from the route, beyond which the car follows it no more


def arc_between(start: np.ndarray, end: np.ndarray, car: Car) -> tuple[float, float]:
    """Return the arc that joins two poses (m, rad): its length, negative backwards (m), and the steering (rad)."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    turn = float(wrap_angle(end[2] - start[2]))
    ahead = np.cos(start[2] + 0.5 * turn) * dx + np.sin(start[2] + 0.5 * turn) * dy  # along its mean heading
    length = float(np.copysign(np.hypot(dx, dy) / np.sinc(0.5 * turn / np.pi), ahead))
    steering = float(np.clip(np.arctan(car.wheelbase * turn / length), -car.max_steering, car.max_steering))
    return length, steering


class Lead:
    """Follow one route of poses ``(n, 3)``, n > 1, joined by arcs."""

    def __init__(self, route: np.ndarray, car: Car) -> None:
        poses, gears = [route[0]], [1.0]
        for start, end in pairwise(route):
            length, steering = arc_between(start, end, car)
            lengths = length * np.linspace(0.0, 1.0, int(np.ceil(abs(length) / ROUTE_SPACING)) + 1)[1:]
            poses += list(poses_after(start[2], lengths, turn_of(lengths, steering, car.wheelbase), *start[:2]))
            gears += [np.sign(length)] * len(lengths)
        gears[0] = gears[1]
        self._path = CarPath(np.array(poses), np.array(gears, int), PursuitConfig(setting_off=SPEED))
        self._car, self._progress = car, 0.0

    def step(self, planar: np.ndarray) -> np.ndarray | None:
        """Return the command ``(speed, steering)`` at a pose; None at the route's end, or away from it."""
        command = self._path.follow(planar, self._progress, self._car)
        self._progress = command.progress
        if command.done or command.deviation > ASTRAY:
            return None
        return np.clip(command.control, [-SPEED, -np.inf], [SPEED, np.inf])
