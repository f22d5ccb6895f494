"""Tabulate how near a car's poses are to obstacles: free, within the comfort margin, or colliding (eq. P10).

    level(x, y, heading) = 2 where a rectangle of the pose's bin overlaps an occupied cell, else
                           1 where the nearest cell's and heading's, grown by ``comfort``, does, else 0

A bin is the box of poses that round to one cell and one heading. Level 2 is tested for all of it: a pose whose level is
lower does not collide, at any point of its bin.
"""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Kernel, cells_under, dilate, heading_grid, rectangle_collisions

CLEAR, TIGHT, COLLIDING = 0, 1, 2  # levels, see the module


class Lookup(NamedTuple):
    """Hold what compiled code reads to look a pose up: levels, their origin (m) and resolution (m)."""

    levels: np.ndarray
    x: float
    y: float
    resolution: float


@dataclass(frozen=True)
class FootprintLevels:
    """Hold the level of every cell and heading.

    Attributes:
        levels: ``(nx, ny, n_headings)`` uint8; heading ``k`` is ``2 pi k / n_headings``.
        origin: ``(2,)`` world position of the centre of cell ``[0, 0]``, m.
        resolution: between cell centres, m.
    """

    levels: np.ndarray
    origin: np.ndarray
    resolution: float

    @classmethod
    def from_occupied(
        cls,
        occupied: np.ndarray,
        origin: np.ndarray,
        resolution: float,
        car: Car,
        *,
        headings: int = 72,
        margin: float = 0.0,
        comfort: float = 0.06,
    ) -> "FootprintLevels":
        """Tabulate a floor plan ``(nx, ny)`` bool; ``margin`` (level 2) and ``comfort`` widen the rectangle, m."""
        if headings < 8:
            raise InputError("FootprintLevels", "headings", f"8 or more; found {headings!r:.80}")
        grid = heading_grid(headings)
        half = 0.5 * np.array([resolution, resolution, 2.0 * np.pi / headings])
        corners = half * np.array([*itertools.product((-1.0, 1.0), repeat=3), (0.0, 0.0, 0.0)])
        # Between its corners a bin's rectangles reach no further than this beyond those of the corners.
        bulge = car.length * (1.0 - np.cos(half[2]))
        poses = [corners + np.array([0.0, 0.0, heading]) for heading in grid]
        wide = [Kernel.of(cells_under(p, resolution, car, margin + bulge)) for p in poses]
        touching = np.moveaxis(dilate(occupied, wide), 0, -1)
        tight = rectangle_collisions(occupied, resolution, car, grid, comfort)
        levels = np.where(touching, COLLIDING, np.where(tight, TIGHT, CLEAR)).astype(np.uint8)
        return cls(np.ascontiguousarray(levels), np.asarray(origin, dtype=np.float64), float(resolution))

    @property
    def lookup(self) -> Lookup:
        """Return the table for compiled code."""
        return Lookup(self.levels, float(self.origin[0]), float(self.origin[1]), self.resolution)

    def at(self, planar: np.ndarray) -> np.ndarray:
        """Return the levels of poses ``(..., 3)``; beyond the grid everything collides."""
        rows = np.asarray(planar, dtype=np.float64).reshape(-1, 3)
        return _levels_at(self.lookup, np.ascontiguousarray(rows)).reshape(np.shape(planar)[:-1])


@njit(cache=True, nogil=True)
def level_at(lookup: Lookup, x: float, y: float, heading: float) -> int:
    """Return the level of the nearest cell and heading."""
    nx, ny, nh = lookup.levels.shape
    i = int(np.floor((x - lookup.x) / lookup.resolution + 0.5))
    j = int(np.floor((y - lookup.y) / lookup.resolution + 0.5))
    if not (0 <= i < nx and 0 <= j < ny):
        return COLLIDING
    return int(lookup.levels[i, j, int(np.floor(heading * nh / (2.0 * np.pi) + 0.5)) % nh])


@njit(cache=True, nogil=True)
def _levels_at(lookup, rows):
    levels = np.empty(rows.shape[0], np.uint8)
    for k in range(rows.shape[0]):
        levels[k] = level_at(lookup, rows[k, 0], rows[k, 1], rows[k, 2])
    return levels
