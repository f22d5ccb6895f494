"""Make floor plans and yards for tests of the car, and check its true outline and its arcs by hand."""

import numpy as np
import shapely

from tests.helpers.box_rooms import PLAIN, furniture
from vssm_gym.envs.scenes.scene import Apartment, Furniture, Room, Wall
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint_levels import FootprintLevels

CAR = Car()
RESOLUTION = 0.025  # m


def occupied(width: float, height: float, *boxes: tuple[float, float, float, float]) -> np.ndarray:
    """Return a room from (0, 0) to ``(width, height)`` with walls as border cells and boxes ``(x0, y0, x1, y1)``, m."""
    x, y = np.meshgrid(np.arange(0.0, width, RESOLUTION), np.arange(0.0, height, RESOLUTION), indexing="ij")
    grid = np.zeros(x.shape, bool)
    grid[[0, -1]] = grid[:, [0, -1]] = True
    for x0, y0, x1, y1 in boxes:
        grid |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    return grid


def levels(grid: np.ndarray, **options: float) -> FootprintLevels:
    return FootprintLevels.from_occupied(grid, np.zeros(2), RESOLUTION, CAR, **options)


def solid(grid: np.ndarray) -> shapely.Geometry:
    """Return the occupied cells as one exact shape."""
    half = 0.5 * RESOLUTION
    centres = RESOLUTION * np.argwhere(grid)
    return shapely.union_all(shapely.box(*(centres - half).T, *(centres + half).T))


def collides(shape: shapely.Geometry, poses: np.ndarray) -> np.ndarray:
    """Return whether the car's exact rectangle at poses ``(n, 3)`` overlaps ``shape``, by shapely."""
    outlines = shapely.polygons(CAR.corners(poses))
    return shapely.area(shapely.intersection(outlines, shape)) > 1e-9


def move(planar: np.ndarray, control: np.ndarray, dt: float = CAR.dt) -> np.ndarray:
    """Move the kinematic bicycle one step in float64, as a rotation about the circle's centre."""
    s, turn = control[0] * dt, control[0] * dt * np.tan(control[1]) / CAR.wheelbase
    chord = s * np.sinc(0.5 * turn / np.pi)
    x = planar[0] + chord * np.cos(planar[2] + 0.5 * turn)
    y = planar[1] + chord * np.sin(planar[2] + 0.5 * turn)
    return np.array([x, y, (planar[2] + turn + np.pi) % (2.0 * np.pi) - np.pi])


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


# A slot for one car, 0.32 m deep between two boxes, along the lower wall: 0.62 m long for a car of 0.39 m.
PARKING = occupied(2.4, 1.6, (0.3, 0.0, 0.89, 0.32), (1.51, 0.0, 2.1, 0.32))
PARKED = np.array([1.07, 0.16, 0.0])
# A corridor that ends: 0.5 m wide, too narrow to turn in.
DEAD_END = occupied(3.0, 2.0, (0.0, 0.7, 2.0, 0.75), (0.0, 1.25, 2.0, 1.3))
# A cell that no car gets into.
SEALED = occupied(3.0, 2.0, (1.9, 0.0, 1.95, 2.0))
