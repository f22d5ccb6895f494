"""Describe the floor of a room before it is furnished: outline, walls, and what its doors and windows keep free.

Rooms are axis-parallel here, as those of the generator and those of hand-drawn plans. `plan_ground` makes the same
description of rooms of any other outline.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import ROUNDING, Door, Room, Window
from vssm_gym.envs.scenes.generator.quarter_turns import contains
from vssm_gym.envs.scenes.solids import SolidBox, footprint

BACK_GAP = 0.01  # m between a piece's back and the wall
APPROACH = 0.6  # m before and behind a door that stay free
_WINDOW_DEPTH = 0.15  # m before a window that stay free

_TURNS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])  # the piece's x axis after q quarter turns


class Edge:
    """Hold a wall of one thickness as seen from a room: from ``start``, on its face, along ``u`` for ``length`` m.

    The room lies to its left; ``turn`` are the quarter turns of u, ``side`` is the edge of the room's outline.
    """

    def __init__(self, start: np.ndarray, end: np.ndarray, thickness: float, side: int) -> None:
        self.length = float(np.abs(end - start).sum())
        self.u = np.round((end - start) / self.length)
        self.n = np.array([-self.u[1], self.u[0]])
        self.start = start + self.n * 0.5 * thickness
        self.turn = int(np.flatnonzero((self.u == _TURNS).all(axis=1))[0])
        self.side = side


@dataclass(frozen=True)
class Ground:
    """Hold what is known of a room before anything is placed in it.

    ``corners`` (n, 2) m of its axis-parallel outline, counter-clockwise; ``solids`` (n, 6) low and high corners of what
    stands there: walls and leaves; ``closed`` (n, 6) blocks of air that stay free before doors and windows; ``entries``
    a free point (2,) before each door; ``edges`` its walls; ``margin`` m that pieces keep from an edge's ends.
    """

    corners: Float[np.ndarray, "n 2"]
    solids: Float[np.ndarray, "m 6"]
    closed: Float[np.ndarray, "k 6"]
    entries: list[np.ndarray]
    edges: list[Edge]
    margin: float


def ground_of(apartment: Apartment, boxes: list[SolidBox], room: Room) -> Ground:
    """Return the ground of a room whose outline runs along the centre lines of axis-parallel walls.

    Args:
        apartment: walls, doors and windows.
        boxes: the apartment's boxes.
        room: one of its rooms.
    """
    corners = np.array(room.polygon)
    solids, floor = [], shapely.Polygon(room.polygon)
    for box in boxes:
        if box.kind not in ("wall", "door", "window"):
            continue
        # Only this room's half of a wall: a leaf behind it leaves no gap here.
        here = footprint(box).intersection(floor)
        if here.area > 1e-6:
            a, b, c, d = here.bounds
            z, h = box.center[2], 0.5 * box.size[2]
            solids.append((a, b, z - h, c, d, z + h))
    closed, entries = kept_free(apartment, corners, 0.0)
    sides = enumerate(itertools.pairwise([*corners, corners[0]]))
    edges = [edge for i, (a, b) in sides for edge in _edges(apartment, i, a, b)]
    # The ends of an edge lie on the centre lines of the walls that meet it.
    margin = max(wall.thickness for wall in apartment.walls) / 2 + BACK_GAP
    return Ground(corners, np.round(np.array(solids), 6), closed, entries, edges, margin)


def kept_free(
    apartment: Apartment, corners: Float[np.ndarray, "n 2"], behind: float
) -> tuple[Float[np.ndarray, "k 6"], list[np.ndarray]]:
    """Return the air that stays free before the doors and windows of a room, and a free point before each door.

    Args:
        apartment: walls, doors and windows of all rooms.
        corners: of the room's axis-parallel outline.
        behind: the part of a wall's thickness between its centre line and the outline, 0 or 0.5.
    """
    zones, entries, inside = [], [], contains(corners)
    holes: list[Door | Window] = [*apartment.doors, *apartment.windows]
    for hole in holes:
        wall = apartment.walls[hole.wall]
        c, s = math.cos(wall.yaw), math.sin(wall.yaw)
        u, n = np.array([c, s]), np.array([-s, c])
        if max(abs(c), abs(s)) > 1.0 - 1e-3:
            u, n = u.round(), n.round()
        middle = np.array(wall.start) + u * (hole.offset + 0.5 * hole.width)
        reach = _WINDOW_DEPTH
        if isinstance(hole, Door):
            reach = max(hole.width, APPROACH) if hole.leaves else APPROACH
        for inward in (n, -n):
            if not inside((middle + (0.3 + behind * wall.thickness) * inward)[None])[0]:
                continue
            far = middle + (0.5 * wall.thickness + reach) * inward
            half = 0.5 * hole.width * u
            ends = np.stack([middle - half, middle + half, far - half, far + half])
            z0 = wall.base + hole.sill
            zones.append((*ends.min(axis=0), z0, *ends.max(axis=0), z0 + hole.height))
            if isinstance(hole, Door):
                entries.append(middle + (0.5 * wall.thickness + 0.3) * inward)
    return np.round(np.array(zones, dtype=np.float64).reshape(-1, 6), 6), entries


def _edges(apartment: Apartment, side: int, a: np.ndarray, b: np.ndarray) -> list[Edge]:
    """Return the walls along edge a -> b, joined where they are equally thick."""
    axis = int(abs(b[1] - a[1]) > abs(b[0] - a[0]))
    low, high = sorted((a[axis], b[axis]))
    runs: list[tuple[float, float, float]] = []  # from, to, thickness
    for wall in sorted(apartment.walls, key=lambda w: min(w.start[axis], w.end[axis])):
        p, q = sorted((wall.start[axis], wall.end[axis]))
        on_line = max(abs(end[1 - axis] - a[1 - axis]) for end in (wall.start, wall.end)) < ROUNDING
        if not on_line or not low < 0.5 * (p + q) < high:
            continue
        if runs and runs[-1][2] == wall.thickness:
            runs[-1] = (runs[-1][0], q, wall.thickness)
        else:
            runs.append((p, q, wall.thickness))
    edges = []
    for p, q, thickness in runs:
        start, end = a.copy(), b.copy()
        start[axis], end[axis] = (p, q) if a[axis] < b[axis] else (q, p)
        edges.append(Edge(start, end, thickness, side))
    return edges
