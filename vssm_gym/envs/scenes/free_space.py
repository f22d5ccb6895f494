"""Compute the free positions of a robot: the floor minus every obstacle at its height, grown by its radius.

    free = (floor ⊖ disc(r)) \\ (obstacles ⊕ disc(r))

The floor is the union of the rooms' polygons (they run along the walls' centre lines, so it covers the doorways);
obstacles are the boxes whose z-range meets (0.01 m, robot height). Metres, world frame. This is the simulator's own
geometry, not the agents': tasks and geodesic distances are computed from it.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from shapely import MultiPolygon, Polygon

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.errors import InputError

STEP_HEIGHT = 0.01  # m; lower objects (rugs, thresholds) do not stop the robot
ROOM_AREA = 0.1  # m^2; a room with less of itself within reach is cut off
_QUADRANT = 9  # chords a quarter circle of grown corners
_SIMPLIFY = 1e-5  # m; removes the near-collinear vertices that unions leave behind
# GEOS fills a corner with chords of up to 1.5 nominal steps whose *ends* lie on the circle. Growing by this much more
# puts the chords outside the circle instead: free space is never too large, and at most 0.9 % of the radius too small.
_OUTSET = 1.0 / math.cos(0.75 * (0.5 * math.pi / _QUADRANT))


class FreeSpace:
    """Hold the free positions of a disc of ``radius`` on a ``floor`` with named ``obstacles``.

    ``region`` is all of it, ``largest`` its largest connected part, which holds starts and goals. ``rooms`` maps the
    parts of the floor to their names. ``source`` (scene name or file) appears in errors.
    """

    def __init__(
        self,
        source: str,
        floor: Polygon | MultiPolygon,
        obstacles: Sequence[tuple[str, Polygon]],
        radius: float,
        rooms: Mapping[str, Polygon],
    ) -> None:
        self.source, self.radius, self.rooms = source, radius, dict(rooms)
        self._floor, self._obstacles = floor, list(obstacles)
        self._solid = shapely.union_all([shape for _, shape in self._obstacles])
        grow = radius * _OUTSET + _SIMPLIFY
        free = floor.buffer(-grow, quad_segs=_QUADRANT) - self._solid.buffer(grow, quad_segs=_QUADRANT)
        parts = [part for part in shapely.get_parts(free.simplify(_SIMPLIFY)) if part.area > 1e-4]
        if not parts:
            raise InputError(source, "rooms", f"room for a robot of radius {radius} m; no position is free")
        parts.sort(key=lambda part: part.area, reverse=True)
        self.region = MultiPolygon(parts)
        self.largest: Polygon = parts[0]
        shapely.prepare(self.region)
        shapely.prepare(self.largest)

    @classmethod
    def from_apartment(cls, apartment: Apartment, radius: float, height: float) -> "FreeSpace":
        """Return the free space of an upright cylinder in an apartment.

        Raise :class:`InputError` where it fits nowhere.
        """
        rooms = {room.name: Polygon(room.polygon) for room in apartment.rooms}
        obstacles = [
            (box.name, footprint(box))
            for box in apartment.boxes()
            if box.center[2] - 0.5 * box.size[2] < height and box.center[2] + 0.5 * box.size[2] > STEP_HEIGHT
        ]
        return cls(apartment.name, shapely.union_all(list(rooms.values())), obstacles, radius, rooms)

    def widened(self, margin: float) -> "FreeSpace":
        """Return the free space of a disc ``margin`` m larger.

        The positions that keep this distance from everything.
        """
        return FreeSpace(self.source, self._floor, self._obstacles, self.radius + margin, self.rooms)

    def contains(self, xy: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Return True where positions are free: in ``region``, its border included."""
        xy = np.asarray(xy, dtype=np.float64)
        return np.asarray(shapely.intersects_xy(self.region, xy[..., 0], xy[..., 1]))

    def distance_to_obstacle(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Return the distance to the nearest obstacle or the end of the floor, m.

        0 inside an obstacle or off the floor.
        """
        points = shapely.points(np.asarray(xy, dtype=np.float64))
        return np.asarray(shapely.distance(self._blocked, points))

    def distance_to_solid(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Return the distance to the nearest obstacle, m, where the end of the floor is none."""
        return np.asarray(shapely.distance(self._solid, shapely.points(np.asarray(xy, dtype=np.float64))))

    def off_the_floor(self) -> str:
        """Return what to say of a place off the floor: how far the floor extends."""
        left, front, right, back = self._floor.bounds
        return f"that is off the floor, whose x is {left:.1f} to {right:.1f} m and y {front:.1f} to {back:.1f} m"

    def obstacles_at(self, xy: ArrayLike) -> list[str]:
        """Return the names of the obstacles that a robot at ``xy`` would collide with, nearest first."""
        point = shapely.points(xy)
        near = [(shape.distance(point), name) for name, shape in self._obstacles]
        return list(dict.fromkeys(name for distance, name in sorted(near) if distance < self.radius * _OUTSET))

    def nearest(self, xy: ArrayLike) -> Float[np.ndarray, "2"]:
        """Return ``xy`` itself where free, else the nearest position 0.1 mm inside free space.

        A robot pressed against a wall may overlap it by the solver's tolerance; this gives its geodesics a start.
        """
        xy = np.asarray(xy, dtype=np.float64)
        if self.contains(xy):
            return xy
        return shapely.get_coordinates(shapely.shortest_line(self._inside, shapely.points(xy)))[0]

    def sample(self, rng: np.random.Generator, n: int, margin: float = 0.0) -> Float[np.ndarray, "n 2"]:
        """Draw ``n`` positions uniformly in ``largest``, at least ``margin`` m from its border, by rejection.

        Raises :class:`InputError` where no such position exists.
        """
        area = self.largest if margin == 0.0 else self.largest.buffer(-margin)
        if area.is_empty:
            raise InputError(self.source, "margin", f"positions {margin} m inside free space; there are none")
        shapely.prepare(area)
        low, high = np.split(np.array(area.bounds), 2)
        found = np.zeros((0, 2))
        while len(found) < n:
            # A fixed block size: the first positions of a seed do not depend on how many are asked for.
            block = rng.uniform(low, high, (256, 2))
            found = np.concatenate([found, block[shapely.contains_xy(area, block)]])
        return found[:n]

    def cut_off_rooms(self) -> list[str]:
        """Return the names of the rooms of which (nearly) nothing belongs to the largest connected part."""
        return [name for name, room in self.rooms.items() if self.largest.intersection(room).area < ROOM_AREA]

    def check_connected(self) -> None:
        """Raise :class:`InputError` naming the rooms that the robot cannot reach from the rest."""
        if names := self.cut_off_rooms():
            kept = f"{self.largest.area:.1f} m^2 of free space is connected"
            raise InputError(self.source, "rooms", f"all of them connected; cut off: {', '.join(names)} ({kept})")

    def notice(self, notes: Sequence[str]) -> str:
        """Return one line for the user: the scene's ``notes`` and the rooms that are cut off; empty for a plain scene.

        A file's own warning may refer to another robot, so the line also says where this one reaches every room.
        """
        sentences = [note.rstrip(".") for note in notes]
        if names := self.cut_off_rooms():
            sentences.append(f"cut off from the rest: {', '.join(names)}; only the largest connected part is used")
        elif sentences:
            sentences.append(f"checked: a robot {2.0 * self.radius:g} m across reaches every room")
        return "; ".join(sentences)

    @cached_property
    def _blocked(self) -> shapely.Geometry:
        """Return everything that is not floor between obstacles, near enough to matter to points on the floor."""
        low, high = np.split(np.array(self._floor.bounds), 2)
        around = shapely.box(*(low - 1.0), *(high + 1.0)) - self._floor
        blocked = shapely.union_all([around, self._solid])
        shapely.prepare(blocked)
        return blocked

    @cached_property
    def _inside(self) -> shapely.Geometry:
        return self.region.buffer(-1e-4)
