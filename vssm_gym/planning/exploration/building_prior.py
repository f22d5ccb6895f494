"""Model the unknown space of a building: surfaces at random within its outline, little to see beyond it (eq. P38).

    h(c) = inside    within the rectangle, along the building's main direction, around all that is known
           outside   beyond it                                 expected surfaces that a ray meets per metre, 1/m

Most buildings are rectangles of rooms. A gap in a wall that leads into the rectangle leads into a room that was not
seen yet; one that leads out of it leads mostly to a facade that was not seen yet. The rectangle grows with what is
known.
"""

import math

import numpy as np

from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import OCCUPIED, UNKNOWN

COMPARED_TURNS = 30  # directions of a quarter turn that are compared, 3 degrees apart


def main_direction(plan: FloorPlan) -> float:
    """Return the angle in [0, pi/2), rad, along which occupied cells line up; 0 where nothing is occupied.

    It maximises the sum of the squared histograms of the cells, projected onto the two axes.
    """
    xy = np.argwhere(plan.cells == OCCUPIED).astype(np.float64)
    if not len(xy):
        return 0.0
    angles = np.arange(COMPARED_TURNS) * 0.5 * math.pi / COMPARED_TURNS
    sharp = np.zeros(COMPARED_TURNS)
    for k, angle in enumerate(angles):
        for shadow in _along(xy, angle):
            sharp[k] += np.square(np.bincount(np.floor(shadow - shadow.min() + 0.5).astype(int))).sum()
    return float(angles[np.argmax(sharp)])


def outline(plan: FloorPlan, also: np.ndarray | None = None) -> np.ndarray:
    """Mark the cells in the rectangle around all that is known, and around places ``also (n, 2)``, m.

    Returns:
        Bool ``(nx, ny)``.
    """
    known = plan.cells != UNKNOWN
    inside = np.ones(known.shape, bool)
    if not known.any():
        return inside
    every = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in known.shape), indexing="ij"), axis=-1)
    angle = main_direction(plan)
    places = (np.reshape(also, (-1, 2)) - plan.origin) / plan.resolution if also is not None else np.empty((0, 2))
    for shadow, further in zip(_along(every, angle), _along(places, angle), strict=True):
        held = np.concatenate([shadow[known], further])
        inside &= (shadow >= held.min()) & (shadow <= held.max())
    return inside


def expected_surfaces(plan: FloorPlan, inside: float, outside: float) -> np.ndarray:
    """Return ``h`` (1/m) of each cell of the plan, float32 ``(nx, ny)``."""
    return np.where(outline(plan), np.float32(inside), np.float32(outside))


def over_map(plan: FloorPlan, values: np.ndarray, beyond: float, m: VoxelMap) -> np.ndarray:
    """Extend values of a plan's cells ``(nx, ny)`` to all columns of the map that it was cut from."""
    columns = np.full(m.shape[:2], beyond, values.dtype)
    i, j = np.round((plan.origin - np.asarray(m.origin, np.float64)[:2]) / plan.resolution).astype(int)
    columns[i : i + values.shape[0], j : j + values.shape[1]] = values
    return columns


def _along(xy: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of points ``(..., 2)`` along the direction ``angle`` (rad) and across it."""
    c, s = math.cos(angle), math.sin(angle)
    return xy @ np.array([c, s]), xy @ np.array([-s, c])
