"""Hold the points of several scans as a surface: denoised places with normals, and a search tree over them.

    m = sum_j w_j p_j,   n = the direction of least spread of the p_j,    over the points within a radius of a place

Points count together only where they were seen from the same side, so that a thin wall has two surfaces.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from vssm_gym.data.laser_logs import LaserLog, compose

SURFACE_RADIUS = 3.0  # cells around a place, of the points that make its normal
FEWEST_NEIGHBOURS = 3  # points that make a normal
MOST_ROUND = 0.25  # ratio of the variances across and along, above which a place is a corner
SIDES = 8  # directions from which a cell is seen, that are kept apart


@dataclass(frozen=True)
class Points:
    """Hold points and the unit vectors from each to the scanner that saw it."""

    places: Float[np.ndarray, "n 2"]
    views: Float[np.ndarray, "n 2"]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.places)

    def moved(self, pose: Float[np.ndarray, "3"]) -> "Points":
        """Return the points as seen from the frame in which their own has the pose ``pose``."""
        turn = rotation(pose[2])
        return Points(self.places @ turn.T + pose[:2], self.views @ turn.T)


@dataclass(frozen=True)
class Cloud:
    """Hold a surface."""

    places: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]  # towards the scanner
    tree: Any


def rotation(turn: float) -> Float[np.ndarray, "2 2"]:
    """Return the matrix of a turn, rad."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s], [s, c]])


def points_of(log: LaserLog, scan: int, max_range: float) -> Points:
    """Return a scan's points in the frame of the robot; readings from ``max_range`` (m) on are left out."""
    ranges = log.ranges[scan].astype(float)
    seen = (ranges > 0.0) & (ranges < max_range)
    directions = np.stack([np.cos(log.angles[seen]), np.sin(log.angles[seen])], axis=-1)
    local = np.concatenate([ranges[seen, None] * directions, np.zeros((seen.sum(), 1))], axis=1)
    places = compose(log.mount, local)[:, :2]
    return Points(places, -directions @ rotation(log.mount[2]).T)


def together(parts: list[Points]) -> Points:
    """Return the points of all parts."""
    return Points(np.concatenate([p.places for p in parts]), np.concatenate([p.views for p in parts]))


def surface(points: Points, cell: float) -> Cloud:
    """Return the surface of points: a place for each cell and side; corners and lone points are left out."""
    if not len(points):
        return Cloud(np.zeros((0, 2)), np.zeros((0, 2)), cKDTree(np.zeros((0, 2))))
    side = np.floor((np.arctan2(points.views[:, 1], points.views[:, 0]) / (2.0 * np.pi) + 0.5) * SIDES).astype(int)
    keys = np.column_stack([np.floor(points.places / cell).astype(int), side])
    keys -= keys.min(axis=0)
    extent = keys.max(axis=0) + 1
    chosen = np.unique((keys[:, 0] * extent[1] + keys[:, 1]) * extent[2] + keys[:, 2], return_index=True)[1]
    tree = cKDTree(points.places)
    pairs = cKDTree(points.places[chosen]).sparse_distance_matrix(tree, SURFACE_RADIUS * cell, output_type="ndarray")
    i, j, apart = pairs["i"], pairs["j"], pairs["v"]
    weight = np.exp(-2.0 * (apart / (SURFACE_RADIUS * cell)) ** 2)
    weight *= (points.views[chosen][i] * points.views[j]).sum(axis=1) > 0.0
    count = len(chosen)
    total = lambda values: np.bincount(i, weight * values, count)
    mass, near = total(1.0), np.bincount(i, weight > 0.0, count)
    x, y = points.places[j].T
    mx, my = total(x) / mass, total(y) / mass
    dx, dy = x - mx[i], y - my[i]
    xx, xy, yy = total(dx * dx) / mass, total(dx * dy) / mass, total(dy * dy) / mass
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    across = 0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * np.pi
    normals = np.stack([np.cos(across), np.sin(across)], axis=-1)
    normals *= np.where((normals * points.views[chosen]).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    kept = (near >= FEWEST_NEIGHBOURS) & (middle - half < MOST_ROUND * (middle + half))
    places = np.stack([mx, my], axis=-1)[kept]
    return Cloud(places, normals[kept], cKDTree(places))
