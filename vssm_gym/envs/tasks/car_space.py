"""Compute which poses of the car are free, and which of them it can drive between, for its exact rectangle among boxes.

    free = {(x, y, heading): R(heading) rectangle + (x, y) meets no box of the car's height}

Rectangles are compared by the separating-axis test. Reachability is read from a lattice of poses joined by short arcs
at full lock and straight lines, driven either way: a car that backs up can retrace its path, so that poses are
reachable from each other or not at all, and each has the label of its connected part. This is the simulator's own
geometry, not the agents'. Metres, rad, world frame; poses are of the rear axle.
"""

import itertools
import math
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vssm_gym.envs.physics import obstacles
from vssm_gym.envs.physics.planar import rectangles
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle

LATTICE_CELL = 0.05  # m between the lattice's poses
LATTICE_HEADINGS = 64  # of the lattice, evenly spread
LATTICE_MARGIN = 0.03  # m that the lattice's poses keep from everything: room to err while manoeuvring
ARC_TURNS = (3, 4)  # steps of heading that arcs turn: 0.13 and 0.18 m at full lock. Coprime: every heading can be had
SAME_PART = 0.15  # m, and m of wheelbase times rad: less than lies between two cars with a fence between them
_CHECKED_AT = (0.25, 0.5, 0.75, 1.0)  # shares of an arc at which it has to be free


class CarSpace:
    """Hold the free poses of ``car`` in an apartment; see the module."""

    def __init__(self, apartment: Apartment, car: Car) -> None:
        boxes = apartment.boxes()
        low = [boxes[i] for i in obstacles(boxes, car.height)]
        self.car = car
        self.floor = shapely.union_all([shapely.Polygon(room.polygon) for room in apartment.rooms])
        shapely.prepare(self.floor)
        self._names, self._rectangles = [box.name for box in low], rectangles(low)
        bounds = np.array(self.floor.bounds)
        self.low, self.high = bounds[:2], bounds[2:]

    def free(self, planar: Float[np.ndarray, "*batch 3"], margin: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Return True where the footprint, grown by ``margin`` m, meets no box, and the rear axle is on the floor."""
        planar = np.asarray(planar, dtype=np.float64)
        flat = np.ascontiguousarray(planar.reshape(-1, 3))
        inside = np.asarray(shapely.intersects_xy(self.floor, flat[:, 0], flat[:, 1]))
        first = _first_met(flat, self._rectangles, self.car.center_forward, *self._half(margin))
        return (inside & (first < 0)).reshape(planar.shape[:-1])

    def obstacles_at(self, planar: PlanarPose) -> list[str]:
        """Return the names of the walls, doors and furniture that the footprint meets, each once."""
        pose = np.array(planar, dtype=np.float64).reshape(1, 3)
        half = self._half(0.0)
        met = [
            name
            for name, one in zip(self._names, self._rectangles, strict=True)
            if _first_met(pose, one[None], self.car.center_forward, *half)[0] >= 0
        ]
        return list(dict.fromkeys(met))

    def sample(self, rng: np.random.Generator, n: int, margin: float) -> Float[np.ndarray, "n 3"]:
        """Draw ``n`` poses, uniform over the floor's bounds and all headings.

        Return those that are free with ``margin``.
        """
        poses = rng.uniform([*self.low, -np.pi], [*self.high, np.pi], (n, 3))
        return poses[self.free(poses, margin)]

    @cached_property
    def labels(self) -> Int[np.ndarray, "nx ny headings"]:
        """Return the connected part of each pose of the lattice, 0 for the largest; -1 where it is not free.

        Cell (0, 0) lies at ``low``, heading k is ``2 pi k / LATTICE_HEADINGS``.
        """
        shape = np.ceil((self.high - self.low) / LATTICE_CELL).astype(int) + 1
        x, y = (self.low[axis] + LATTICE_CELL * np.arange(shape[axis]) for axis in range(2))
        heading = 2.0 * np.pi * np.arange(LATTICE_HEADINGS) / LATTICE_HEADINGS
        free = self.free(np.stack(np.meshgrid(x, y, heading, indexing="ij"), axis=-1), LATTICE_MARGIN)
        index = np.arange(free.size, dtype=np.int32).reshape(free.shape)
        starts, ends = [], []
        for k in range(LATTICE_HEADINGS):
            for curvature, turn in itertools.product((-1, 0, 1), ARC_TURNS):
                cells = self._cells_along(k, curvature, turn)
                passable = free[:, :, k].copy()
                for i, j, then in cells:
                    passable &= _shifted(free[:, :, then], i, j)
                i, j, then = cells[-1]
                starts.append(index[:, :, k][passable])
                ends.append(_shifted(index[:, :, then], i, j)[passable])
        start, end = np.concatenate(starts), np.concatenate(ends)
        graph = coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(free.size, free.size))
        _, part = connected_components(graph, directed=False)
        _, ranked, count = np.unique(part[free.reshape(-1)], return_inverse=True, return_counts=True)
        rank = np.empty(len(count), dtype=np.int32)
        rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
        labels = np.full(free.shape, -1, dtype=np.int32)
        labels[free] = rank[ranked]
        return labels

    def part(self, planar: PlanarPose) -> int:
        """Return the label of the largest part that comes within SAME_PART of a pose; -1 where none does.

        A car pressed against an obstacle belongs to the part that it came from, and one next to a pose without an exit
        to the part around that pose.
        """
        states, labels = self._around(np.asarray(planar[:2]), SAME_PART)
        turn = np.abs(wrap_angle(states[:, 2] - planar[2]))
        away = np.hypot(*(states[:, :2] - planar[:2]).T) + self.car.wheelbase * turn
        return int(min(labels[away <= SAME_PART], default=-1))

    def parts_within(self, goal: Float[np.ndarray, "2"] | PlanarPose, radius: float, angle: float) -> set[int]:
        """Return the labels of the free lattice poses within ``radius`` m of a goal, and ``angle`` rad of a pose."""
        states, labels = self._around(np.asarray(goal[:2]), radius)
        near = np.hypot(*(states[:, :2] - goal[:2]).T) <= radius
        if len(goal) == 3:
            near &= np.abs(wrap_angle(states[:, 2] - goal[2])) <= angle
        return set(labels[near].tolist())

    def _around(self, xy: Float[np.ndarray, "2"], radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the lattice's free poses in the square of half side ``radius`` around ``xy``, and their labels."""
        first = np.maximum(np.ceil((xy - radius - self.low) / LATTICE_CELL), 0).astype(int)
        last = np.maximum(np.floor((xy + radius - self.low) / LATTICE_CELL), -1).astype(int) + 1
        labels = self.labels[first[0] : last[0], first[1] : last[1]]
        i, j, k = np.nonzero(labels >= 0)
        x, y = self.low[0] + LATTICE_CELL * (i + first[0]), self.low[1] + LATTICE_CELL * (j + first[1])
        return np.stack([x, y, 2.0 * np.pi / LATTICE_HEADINGS * k], axis=-1), labels[i, j, k]

    def _cells_along(self, k: int, curvature: int, turn: int) -> list[tuple[int, int, int]]:
        """Return the cells ``(i, j, heading)`` relative to the first, along an arc, or a line of its length."""
        heading = 2.0 * math.pi * k / LATTICE_HEADINGS
        cells = []
        for share in _CHECKED_AT:
            a = 2.0 * math.pi * share * turn / LATTICE_HEADINGS  # rad along an arc at full lock
            forward, left = (math.sin(a), 1.0 - math.cos(a)) if curvature else (a, 0.0)
            forward, left = self.car.turning_radius * forward, self.car.turning_radius * curvature * left
            x = math.cos(heading) * forward - math.sin(heading) * left
            y = math.sin(heading) * forward + math.cos(heading) * left
            then = round(k + curvature * share * turn) % LATTICE_HEADINGS
            cells.append((round(x / LATTICE_CELL), round(y / LATTICE_CELL), then))
        return cells

    def _half(self, margin: float) -> tuple[float, float]:
        return 0.5 * self.car.length + margin, 0.5 * self.car.width + margin


def _shifted(plane: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return ``plane[x + i, y + j]`` at every (x, y); 0 beyond its border."""
    moved = np.zeros_like(plane)
    nx, ny = plane.shape
    to = (slice(max(0, -i), nx - max(0, i)), slice(max(0, -j), ny - max(0, j)))
    moved[to] = plane[max(0, i) : nx - max(0, -i), max(0, j) : ny - max(0, -j)]
    return moved


@njit(cache=True, nogil=True)
def _first_met(
    poses: np.ndarray, rectangles: np.ndarray, forward: float, half_length: float, half_width: float
) -> np.ndarray:
    """Return the index of the first rectangle that each footprint meets; -1 for none.

    Rectangles are those of :mod:`vssm_gym.envs.physics.planar`. Two rectangles are apart if the line through their
    centres, projected on one of their four axes, is longer than what both of them cover of it.
    """
    first = np.full(len(poses), -1, dtype=np.int32)
    for n in range(len(poses)):
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        x, y = poses[n, 0] + forward * c, poses[n, 1] + forward * s
        for m in range(len(rectangles)):
            at_x, at_y, cos, sin, half_x, half_y = rectangles[m]
            dx, dy = at_x - x, at_y - y
            # cosine and sine between the two, in absolute value: a rectangle is symmetric
            along, across = abs(c * cos + s * sin), abs(c * sin - s * cos)
            if abs(c * dx + s * dy) > half_length + half_x * along + half_y * across:
                continue
            if abs(c * dy - s * dx) > half_width + half_x * across + half_y * along:
                continue
            if abs(cos * dx + sin * dy) > half_x + half_length * along + half_width * across:
                continue
            if abs(cos * dy - sin * dx) > half_y + half_length * across + half_width * along:
                continue
            first[n] = m
            break
    return first
