"""A furnished apartment as data: rooms, walls with thickness, doors, windows and furniture made of boxes.

World frame: z up, metres, radians; the finished floor is z = 0. Every model is frozen and refuses unknown fields,
NaN and infinities. `parse_apartment` turns plain data into an `Apartment` and reports the first thing wrong with it
as one `InputError` that names the source and the field.
"""

import math
from typing import Annotated, Any, Literal, Self

import shapely
from pydantic import BaseModel, ConfigDict, Field, model_validator

from vssm_gym.envs.content_hash import content_hash
from vssm_gym.envs.solids import SolidBox, solid_boxes
from vssm_gym.envs.textures import TEXTURES
from vssm_gym.envs.validation import validated
from vssm_gym.errors import InputError

FAR = 1000.0  # m, largest coordinate
EXTENT = 250.0  # m, largest apartment
ROOMS, WALLS, HOLES, PIECES, CORNERS = 1000, 20_000, 5000, 20_000, 20_000  # most of one apartment

Coordinate = Annotated[float, Field(ge=-FAR, le=FAR)]
Positive = Annotated[float, Field(gt=0, le=FAR)]
NonNegative = Annotated[float, Field(ge=0, le=FAR)]
Unit = Annotated[float, Field(ge=0, le=1)]
XY = tuple[Coordinate, Coordinate]
XYZ = tuple[Coordinate, Coordinate, Coordinate]

_FIT = 1e-6  # metres of rounding allowed when a hole is checked against its wall


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Material(_Model):
    """How a surface looks: a named texture tinted by a colour.

    ``color`` RGB in [0, 1], multiplied into the texture; ``texture`` a key of `textures.TEXTURES`; ``scale`` metres
    that one repetition of the texture covers, both ways. Textures stand upright. On a face of furniture, a leaf or a
    pane they start at the upper left corner; on walls, floors and ceilings they run through from the world's origin,
    so that the pieces around a door show one pattern.
    """

    color: tuple[Unit, Unit, Unit] = (0.8, 0.8, 0.8)
    texture: str = "plain"
    scale: Positive = 1.0

    @model_validator(mode="after")
    def _known_texture(self) -> Self:
        if self.texture not in TEXTURES:
            raise InputError("material", "texture", f"one of {', '.join(sorted(TEXTURES))}; found {self.texture!r}")
        return self


class Box(_Model):
    """An upright box: ``center`` (x, y, z) m, ``size`` full extents m along its own axes, ``yaw`` rad about z."""

    center: XYZ
    size: tuple[Positive, Positive, Positive]
    yaw: float = 0.0
    material: Material


class Furniture(_Model):
    """A piece of furniture: a unique ``name``, a ``category`` such as "chair", and the solid boxes it is made of."""

    name: str = Field(min_length=1)
    category: str = Field(min_length=1)
    boxes: tuple[Box, ...] = Field(min_length=1, max_length=PIECES)


class Room(_Model):
    """A room: unique ``name``, ``kind`` such as "kitchen", ``floor`` material and its outline.

    ``polygon`` (n, 2) m runs along the centre lines of the surrounding walls, in either direction and without
    repeating the first corner, so that rooms joined by a door share an edge and their union covers the doorway.
    """

    name: str = Field(min_length=1)
    kind: str = Field(min_length=1)
    polygon: tuple[XY, ...] = Field(min_length=3, max_length=CORNERS)
    floor: Material

    @model_validator(mode="after")
    def _simple(self) -> Self:
        shape = shapely.Polygon(self.polygon)
        if not shape.is_valid or shape.area <= 0:
            raise InputError("room", "polygon", f"a simple polygon: {shapely.is_valid_reason(shape)}")
        return self


class Wall(_Model):
    """A straight wall around the centre line ``start`` -> ``end`` (x, y) m.

    It spans z from ``base`` to ``base + height`` and ``thickness`` across. ``front`` covers the side to the left of
    start -> end, ``back`` the side to its right.
    """

    start: XY
    end: XY
    thickness: Positive
    height: Positive
    base: Coordinate = 0.0
    front: Material
    back: Material

    @property
    def length(self) -> float:
        """Distance from start to end, m."""
        return math.dist(self.start, self.end)

    @property
    def yaw(self) -> float:
        """Direction start -> end, rad."""
        return math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])

    @model_validator(mode="after")
    def _long(self) -> Self:
        if self.length < 1e-3:
            raise InputError("wall", "end", "a point at least 1 mm away from start")
        return self


class Door(_Model):
    """A hole from the wall's base up to ``height``, ``offset`` m from the wall's start, ``width`` m along it.

    Each of its ``leaves`` stands at ``openness * 90`` degrees from closed: 0 leaves is an open doorway, 1 is hinged at
    the hole's ``hinge`` end and opens to the wall's ``swing`` side, 2 share the width and hinge at both ends.
    ``rooms`` names the room on either side; the second is None where the door leads outside.
    """

    wall: Annotated[int, Field(ge=0)]
    offset: NonNegative
    width: Positive
    height: Positive
    openness: Unit = 1.0
    leaves: Literal[0, 1, 2] = 1
    hinge: Literal["start", "end"] = "start"
    swing: Literal["front", "back"] = "front"
    rooms: tuple[str, str | None]
    material: Material = Material(color=(0.55, 0.40, 0.27), texture="wood", scale=0.8)

    @property
    def sill(self) -> float:
        """A door starts at its wall's base: 0 m above it."""
        return 0.0


class Window(_Model):
    """A hole filled with a pane, ``sill`` m above the wall's base and ``offset`` m from its start."""

    wall: Annotated[int, Field(ge=0)]
    offset: NonNegative
    width: Positive
    height: Positive
    sill: NonNegative
    material: Material = Material(color=(0.75, 0.85, 0.95), texture="window", scale=1.2)


class Apartment(_Model):
    """A whole apartment; see the fields' own types for frames and units.

    ``ceiling_height`` m is the ceiling's underside. ``notes`` are sentences for the user about how the scene came to
    be (warnings of the file it was imported from, approximations); they are not part of the content hash. ``format``
    is the version of the JSON format; a file of another version is refused.
    """

    format: Literal[1] = 1
    name: str = Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$")  # files are named after it
    rooms: tuple[Room, ...] = Field(min_length=1, max_length=ROOMS)
    walls: tuple[Wall, ...] = Field(min_length=1, max_length=WALLS)
    doors: tuple[Door, ...] = Field((), max_length=HOLES)
    windows: tuple[Window, ...] = Field((), max_length=HOLES)
    furniture: tuple[Furniture, ...] = Field((), max_length=PIECES)
    ceiling_height: Positive
    ceiling: Material = Material(color=(0.93, 0.93, 0.91), texture="plaster", scale=2.0)
    notes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _check_extent(self)
        _check_names(self)
        _check_holes(self)
        return self

    def boxes(self) -> list[SolidBox]:
        """Everything solid as upright boxes: floor, ceiling, walls around their holes, leaves, panes, furniture."""
        return solid_boxes(self)

    def content_hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the canonical JSON without ``notes``."""
        return content_hash(self, without="notes")


def _check_extent(apartment: Apartment) -> None:
    for field, shapes in (
        ("rooms", [room.polygon for room in apartment.rooms]),
        ("walls", [(wall.start, wall.end) for wall in apartment.walls]),
    ):
        for axis in range(2):
            values = [point[axis] for shape in shapes for point in shape]
            if max(values) - min(values) > EXTENT:
                expected = f"at most {EXTENT:g} m across; found {max(values) - min(values):.1f}"
                raise InputError(apartment.name, field, expected)


def _check_names(apartment: Apartment) -> None:
    for field in ("rooms", "furniture"):
        seen: set[str] = set()
        for i, item in enumerate(getattr(apartment, field)):
            if item.name in seen:
                raise InputError(apartment.name, f"{field}[{i}].name", f"a unique name; {item.name!r} occurs twice")
            seen.add(item.name)
    rooms = {room.name for room in apartment.rooms}
    for i, door in enumerate(apartment.doors):
        for side, room in enumerate(door.rooms):
            if room is not None and room not in rooms:
                raise InputError(apartment.name, f"doors[{i}].rooms[{side}]", f"a room's name; found {room!r}")


def _check_holes(apartment: Apartment) -> None:
    """Every door and window lies inside its wall and no two share a stretch of it."""
    taken: dict[int, list[tuple[float, float, str]]] = {}
    holes: list[tuple[str, Door | Window]] = [(f"doors[{i}]", door) for i, door in enumerate(apartment.doors)]
    holes += [(f"windows[{i}]", window) for i, window in enumerate(apartment.windows)]
    for field, hole in holes:
        if hole.wall >= len(apartment.walls):
            expected = f"an index below {len(apartment.walls)}, the number of walls; found {hole.wall}"
            raise InputError(apartment.name, f"{field}.wall", expected)
        wall = apartment.walls[hole.wall]
        start, end = hole.offset, hole.offset + hole.width
        if end > wall.length + _FIT:
            expected = f"offset + width within the wall's {wall.length:.3f} m; found {end:.3f}"
            raise InputError(apartment.name, f"{field}.offset", expected)
        if hole.sill + hole.height > wall.height + _FIT:
            expected = f"a top within the wall's {wall.height:.3f} m; found {hole.sill + hole.height:.3f}"
            raise InputError(apartment.name, f"{field}.height", expected)
        for other_start, other_end, other in taken.setdefault(hole.wall, []):
            if start < other_end - _FIT and other_start < end - _FIT:
                raise InputError(apartment.name, f"{field}.offset", f"a hole that does not overlap {other}")
        taken[hole.wall].append((start, end, field))


def parse_apartment(data: Any, source: object) -> Apartment:
    """The `Apartment` that plain JSON data describes; InputError naming ``source`` and the first bad field."""
    return validated(Apartment, data, source)
