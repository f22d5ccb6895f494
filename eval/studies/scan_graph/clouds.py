"""Hold the points of several scans as a surface: denoised places with normals, and a search tree over them.

    m = sum_j w_j p_j,   n = the direction of least spread of the p_j,    over the points within a radius of a place
    (1 + 1 / mass + u^2 / (mass spread)) s^2,    the variance of a point's distance to it, u along it from m

of points with noise s: a line through few points says little, and less beyond them. A place with too few points has
twice the radius. Points count together only where they were seen from the same side: a thin wall has two surfaces.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.geometry.planar_poses import compose

SURFACE_RADII = (3.0, 6.0)  # cells around a place, of the points that make its normal: the first that has enough
FEWEST_NEIGHBOURS = 3  # points that make a normal
MOST_ROUND = 0.25  # ratio of the variances across and along, above which a place is a corner
VIEW_SIDES = 8  # directions from which a cell is seen, that are kept apart


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
    """Hold a surface.

    Attributes:
        places: m.
        normals: towards the scanner.
        mass: number of points behind each, by weight.
        spread: their variance along the surface, m^2.
        tree: of the places.
    """

    places: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]
    mass: Float[np.ndarray, "n"]
    spread: Float[np.ndarray, "n"]
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
    found = [np.zeros((0, 6))]
    if len(points):
        side = np.floor((np.arctan2(points.views[:, 1], points.views[:, 0]) / (2.0 * np.pi) + 0.5) * VIEW_SIDES).astype(
            int
        )
        keys = np.column_stack([np.floor(points.places / cell).astype(int), side])
        keys -= keys.min(axis=0)
        extent = keys.max(axis=0) + 1
        at = np.unique((keys[:, 0] * extent[1] + keys[:, 1]) * extent[2] + keys[:, 2], return_index=True)[1]
        tree = cKDTree(points.places)
        for radius in SURFACE_RADII:
            if len(at):
                enough, rows = _fitted(points, tree, at, radius * cell)
                found.append(rows)
                at = at[~enough]
    rows = np.concatenate(found)
    return Cloud(rows[:, :2], rows[:, 2:4], rows[:, 4], rows[:, 5], cKDTree(rows[:, :2]))


def _fitted(points: Points, tree: cKDTree, at: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the points ``at`` have enough others around them, and the rows of the surface there."""
    pairs = cKDTree(points.places[at]).sparse_distance_matrix(tree, radius, output_type="ndarray")
    i, j = pairs["i"], pairs["j"]
    weight = np.exp(-2.0 * (pairs["v"] / radius) ** 2)
    weight *= (points.views[at][i] * points.views[j]).sum(axis=1) > 0.0
    total = lambda values: np.bincount(i, weight * values, len(at))
    mass, enough = total(1.0), np.bincount(i, weight > 0.0, len(at)) >= FEWEST_NEIGHBOURS
    x, y = points.places[j].T
    mx, my = total(x) / mass, total(y) / mass
    dx, dy = x - mx[i], y - my[i]
    xx, xy, yy = total(dx * dx) / mass, total(dx * dy) / mass, total(dy * dy) / mass
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    across = 0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * np.pi
    normals = np.stack([np.cos(across), np.sin(across)], axis=-1)
    normals *= np.where((normals * points.views[at]).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    kept = enough & (middle - half < MOST_ROUND * (middle + half))
    return enough, np.column_stack([mx, my, normals, mass, middle + half])[kept]
