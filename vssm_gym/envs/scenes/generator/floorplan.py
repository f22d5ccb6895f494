"""Describe a floor plan in a few words and build the bare apartment: `build` finds the walls between the rooms.

Rooms are rectilinear polygons along the walls' centre lines; doors and windows are points on walls. World frame,
metres. Whoever draws a plan, by hand (`plans`) or by seed (`layout`), never lists a wall.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import (
    CEILING_HEIGHT,
    DOOR_HEIGHT,
    ROUNDING,
    XY,
    Door,
    Material,
    Room,
    Wall,
    Window,
)
from vssm_gym.errors import InputError


@dataclass(frozen=True)
class RoomPlan:
    """Describe a room: ``polygon`` counter-clockwise, axis-parallel.

    ``walls[i]`` is the look of edge i -> i + 1 from inside.
    """

    name: str
    kind: str
    polygon: tuple[XY, ...]
    floor: Material
    walls: tuple[Material, ...]

    @property
    def edges(self) -> list[tuple[XY, XY]]:
        """Return start and end of every edge; the room lies to its left."""
        return list(zip(self.polygon, (*self.polygon[1:], self.polygon[0]), strict=True))


@dataclass(frozen=True)
class DoorPlan:
    """Describe a door centred at ``at`` on a wall, between ``rooms`` (the second None: outside, closed).

    It swings into the room named ``into``, hinged at the end nearer to the wall's end; without one it is a doorway.
    """

    at: XY
    rooms: tuple[str, str | None]
    width: float = 0.9
    into: str | None = None


@dataclass(frozen=True)
class WindowPlan:
    """Describe a window centred at ``at`` on an outer wall."""

    at: XY
    width: float
    height: float = 1.3
    sill: float = 0.9


@dataclass(frozen=True)
class BuildingPlan:
    """Describe a whole floor plan; thicknesses are those of the walls between rooms and towards the outside."""

    name: str
    rooms: tuple[RoomPlan, ...]
    doors: tuple[DoorPlan, ...]
    windows: tuple[WindowPlan, ...]
    facade: Material
    leaf: Material  # of the doors between rooms
    entrance: Material  # of the door to the outside
    height: float = CEILING_HEIGHT
    inner: float = 0.1
    outer: float = 0.14


def build(plan: BuildingPlan) -> Apartment:
    """Return the unfurnished apartment of a plan.

    A wall runs along every edge of a room, one for each stretch with the same two rooms on its sides.

    Raises:
        InputError: a door or window that lies on no wall, or not between the rooms it names.
    """
    walls: list[Wall] = []
    sides: list[tuple[str, str | None]] = []  # rooms at the front and back of each wall
    for (start, end), front, back in _stretches(plan.rooms):
        room, edge = front
        other = plan.facade if back is None else back[0].walls[back[1]]
        thickness = plan.outer if back is None else plan.inner
        look = room.walls[edge]
        walls.append(
            Wall(start=start, end=end, thickness=thickness, height=plan.height, front=look, back=other),
        )
        sides.append((room.name, None if back is None else back[0].name))
    return Apartment(
        name=plan.name,
        rooms=tuple(Room(name=r.name, kind=r.kind, polygon=r.polygon, floor=r.floor) for r in plan.rooms),
        walls=tuple(walls),
        doors=tuple(_door(plan, door, walls, sides) for door in plan.doors),
        windows=tuple(_window(plan, window, walls, sides) for window in plan.windows),
        furniture=(),
        ceiling_height=plan.height,
    )


Side = tuple[RoomPlan, int]  # a room and which of its edges


def _stretches(rooms: tuple[RoomPlan, ...]) -> list[tuple[tuple[XY, XY], Side, Side | None]]:
    """Return every stretch of wall, the side to its left and to its right (None: outside), in the rooms' order."""
    found = []
    for i, room in enumerate(rooms):
        for edge, (a, b) in enumerate(room.edges):
            length = math.dist(a, b)
            u = ((b[0] - a[0]) / length, (b[1] - a[1]) / length)
            cuts = {0.0, length}
            for other in rooms:
                for x, y in other.polygon:
                    along, across = (x - a[0]) * u[0] + (y - a[1]) * u[1], (y - a[1]) * u[0] - (x - a[0]) * u[1]
                    if abs(across) < ROUNDING and ROUNDING < along < length - ROUNDING:
                        cuts.add(round(along, 6))
            merged: list[tuple[float, float, tuple[int, int] | None]] = []
            for s, t in zip(sorted(cuts)[:-1], sorted(cuts)[1:], strict=True):
                middle = 0.5 * (s + t)
                beyond = _room_at(rooms, a[0] + u[0] * middle + u[1] * 0.01, a[1] + u[1] * middle - u[0] * 0.01)
                back = None
                if beyond is not None:
                    back = (beyond, _edge_at(rooms[beyond], (a[0] + u[0] * middle, a[1] + u[1] * middle)))
                if merged and merged[-1][2] == back:
                    merged[-1] = (merged[-1][0], t, back)
                else:
                    merged.append((s, t, back))
            for s, t, back in merged:
                if back is not None and back[0] < i:
                    continue  # the other room has listed it
                ends = [(round(a[0] + u[0] * w, 4), round(a[1] + u[1] * w, 4)) for w in (s, t)]
                found.append(((ends[0], ends[1]), (room, edge), None if back is None else (rooms[back[0]], back[1])))
    return found


def _room_at(rooms: tuple[RoomPlan, ...], x: float, y: float) -> int | None:
    for i, room in enumerate(rooms):
        if shapely.contains_xy(shapely.Polygon(room.polygon), x, y):
            return i
    return None


def _edge_at(room: RoomPlan, at: XY) -> int:
    return int(np.argmin([shapely.LineString(edge).distance(shapely.Point(at)) for edge in room.edges]))


def _on_wall(
    plan: BuildingPlan,
    at: XY,
    width: float,
    walls: list[Wall],
    sides: list[tuple[str, str | None]],
    rooms: set[str | None],
) -> tuple[int, float]:
    """Return the index of the wall under a hole, and the hole's offset from the wall's start."""
    for i, wall in enumerate(walls):
        c, s = math.cos(wall.yaw), math.sin(wall.yaw)
        dx, dy = at[0] - wall.start[0], at[1] - wall.start[1]
        along, across = c * dx + s * dy, c * dy - s * dx
        inside = 0.5 * width - ROUNDING <= along <= wall.length - 0.5 * width + ROUNDING
        if abs(across) < 1e-3 and inside and rooms <= set(sides[i]):
            return i, round(along - 0.5 * width, 4)
    expected = f"a wall of {', '.join(str(room) for room in sorted(rooms, key=str))} under the {width} m around it"
    raise InputError(plan.name, f"hole at {at}", expected)


def _door(plan: BuildingPlan, door: DoorPlan, walls: list[Wall], sides: list[tuple[str, str | None]]) -> Door:
    index, offset = _on_wall(plan, door.at, door.width, walls, sides, set(door.rooms))
    near_start = offset < walls[index].length - offset - door.width
    outside = door.rooms[1] is None
    return Door(
        wall=index,
        offset=offset,
        width=door.width,
        height=DOOR_HEIGHT,
        openness=0.0 if outside else 1.0,
        leaves=0 if door.into is None else 1,
        hinge="start" if near_start else "end",
        swing="front" if door.into == sides[index][0] else "back",
        rooms=door.rooms,
        material=plan.entrance if outside else plan.leaf,
    )


def _window(plan: BuildingPlan, window: WindowPlan, walls: list[Wall], sides: list[tuple[str, str | None]]) -> Window:
    index, offset = _on_wall(plan, window.at, window.width, walls, sides, {None})
    glass = Material(color=(1.0, 1.0, 1.0), texture="window", scale=max(window.width, window.height))
    return Window(wall=index, offset=offset, width=window.width, height=window.height, sill=window.sill, material=glass)
