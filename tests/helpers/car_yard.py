"""Make a wide empty yard, and a room with a gap too narrow for the car."""

import numpy as np

from tests.helpers.box_rooms import PLAIN, furniture
from vssm_gym.envs.scenes.scene import Apartment, Furniture, Room, Wall


def yard(width: float = 12.0, depth: float = 12.0, pieces: tuple[Furniture, ...] = ()) -> Apartment:
    """Return one room [0, width] x [0, depth] between walls 0.1 m thick."""
    corners = ((0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth))
    lines = zip(corners, [*corners[1:], corners[0]], strict=True)
    walls = tuple(Wall(start=a, end=b, thickness=0.1, height=2.0, front=PLAIN, back=PLAIN) for a, b in lines)
    room = Room(name="yard", kind="hall", polygon=corners, floor=PLAIN)
    return Apartment(name="yard", rooms=(room,), walls=walls, doors=(), furniture=pieces, ceiling_height=2.0)


def two_yards() -> Apartment:
    """Return 6 x 3 m, cut in two at x = 3 by a fence with a gap of 0.15 m: the car is 0.19 m wide."""
    south = furniture("fence south", (3.0, 0.7375, 0.25), (0.1, 1.375, 0.5))
    north = furniture("fence north", (3.0, 2.2625, 0.25), (0.1, 1.375, 0.5))
    return yard(6.0, 3.0, (south, north)).model_copy(update={"name": "two yards"})


def arc(planar: np.ndarray, distance: float, curvature: float) -> np.ndarray:
    """Return the position of a bicycle's rear axle after ``distance`` m at a constant curvature."""
    x, y, heading = planar
    if curvature == 0.0:
        return np.array([x + distance * np.cos(heading), y + distance * np.sin(heading), heading])
    turned = heading + distance * curvature
    x += (np.sin(turned) - np.sin(heading)) / curvature
    y -= (np.cos(turned) - np.cos(heading)) / curvature
    return np.array([x, y, turned])
