"""Define the parts of an apartment as data: materials, boxes, furniture, rooms, walls, doors and windows.

World frame: z up, metres, radians; the finished floor is z = 0. Every model is frozen and refuses unknown fields,
NaN and infinities.
"""

import math
from typing import Annotated, Literal, Self

import shapely
from pydantic import Field, model_validator

from vssm_gym.envs.textures.registry import TEXTURES
from vssm_gym.envs.validation import StrictModel
from vssm_gym.errors import InputError

MAX_COORDINATE = 1000.0  # m, bound of all coordinates and lengths, of sensors and policies too
ROUNDING = 1e-6  # m, differences of coordinates that are rounding
DOOR_HEIGHT = 2.05  # m, of doors and of doorways under their lintel, unless a file says otherwise
CEILING_HEIGHT = 2.6  # m, unless a file says otherwise
MOST_PARTS, MOST_CORNERS = 20_000, 20_000  # most boxes of a piece of furniture, most corners of a room

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Positive = Annotated[float, Field(gt=0, le=MAX_COORDINATE)]
NonNegative = Annotated[float, Field(ge=0, le=MAX_COORDINATE)]
Unit = Annotated[float, Field(ge=0, le=1)]
XY = tuple[Coordinate, Coordinate]
XYZ = tuple[Coordinate, Coordinate, Coordinate]


class Material(StrictModel):
    """Define the look of a surface: a named texture tinted by a colour.

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


class Box(StrictModel):
    """Define an upright box.

    ``center`` (x, y, z) m, ``size`` full extents m along its own axes, ``yaw`` rad about z.
    """

    center: XYZ
    size: tuple[Positive, Positive, Positive]
    yaw: float = 0.0
    material: Material


class Furniture(StrictModel):
    """Define a piece of furniture: a unique ``name``, a ``category`` such as "chair", and its solid boxes."""

    name: str = Field(min_length=1)
    category: str = Field(min_length=1)
    boxes: tuple[Box, ...] = Field(min_length=1, max_length=MOST_PARTS)


class Room(StrictModel):
    """Define a room: unique ``name``, ``kind`` such as "kitchen", ``floor`` material and its outline.

    ``polygon`` (n, 2) m runs along the centre lines of the surrounding walls, in either direction and without
    repeating the first corner, so that rooms joined by a door share an edge and their union covers the doorway.
    """

    name: str = Field(min_length=1)
    kind: str = Field(min_length=1)
    polygon: tuple[XY, ...] = Field(min_length=3, max_length=MOST_CORNERS)
    floor: Material = Material(color=(0.72, 0.56, 0.4), texture="planks")

    @model_validator(mode="after")
    def _simple(self) -> Self:
        shape = shapely.Polygon(self.polygon)
        if not shape.is_valid or shape.area <= 0:
            raise InputError("room", "polygon", f"a simple polygon: {shapely.is_valid_reason(shape)}")
        return self


PAINTED = Material(color=(0.9, 0.88, 0.82), texture="plaster", scale=2.0)  # a wall whose material is not stated


class Wall(StrictModel):
    """Define a straight wall around the centre line ``start`` -> ``end`` (x, y) m.

    It spans z from ``base`` to ``base + height`` and ``thickness`` across. ``front`` covers the side to the left of
    start -> end, ``back`` the side to its right.
    """

    start: XY
    end: XY
    thickness: Positive
    height: Positive
    base: Coordinate = 0.0
    front: Material = PAINTED
    back: Material = PAINTED

    @property
    def length(self) -> float:
        """Return the distance from start to end, m."""
        return math.dist(self.start, self.end)

    @property
    def yaw(self) -> float:
        """Return the direction start -> end, rad."""
        return math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])

    @model_validator(mode="after")
    def _long(self) -> Self:
        if self.length < 1e-3:
            raise InputError("wall", "end", "a point at least 1 mm away from start")
        return self


class Door(StrictModel):
    """Define a hole from the wall's base up to ``height``, ``offset`` m from the wall's start, ``width`` m along it.

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
        """Return 0 m: a door starts at its wall's base."""
        return 0.0


class Window(StrictModel):
    """Define a hole filled with a pane, ``sill`` m above the wall's base and ``offset`` m from its start."""

    wall: Annotated[int, Field(ge=0)]
    offset: NonNegative
    width: Positive
    height: Positive
    sill: NonNegative
    material: Material = Material(color=(0.75, 0.85, 0.95), texture="window", scale=1.2)
