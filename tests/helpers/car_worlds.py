"""Make simple floor plans for tests of the car's planners, and check its true outline against them."""

import numpy as np
import shapely

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


def touched(shape: shapely.Geometry, poses: np.ndarray) -> np.ndarray:
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


# A slot for one car, 0.32 m deep between two boxes, along the lower wall: 0.62 m long for a car of 0.39 m.
PARKING = occupied(2.4, 1.6, (0.3, 0.0, 0.89, 0.32), (1.51, 0.0, 2.1, 0.32))
PARKED = np.array([1.07, 0.16, 0.0])
# A corridor that ends: 0.5 m wide, too narrow to turn in.
DEAD_END = occupied(3.0, 2.0, (0.0, 0.7, 2.0, 0.75), (0.0, 1.25, 2.0, 1.3))
# A cell that no car gets into.
SEALED = occupied(3.0, 2.0, (1.9, 0.0, 1.95, 2.0))
