"""Define the parts of a ProcTHOR house (schema 1.0.0) and of its asset database that the importer reads, as typed data.

Unity's frame: left-handed, y up, metres, degrees. Fields that the importer does not read are ignored.
"""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from vssm_gym.envs.scenes.apartment_parts import Coordinate

Openness = Annotated[float, Field(ge=0, le=1)]
Angle = Annotated[float, Field(ge=-1e6, le=1e6)]  # degrees
Extent = Annotated[float, Field(ge=0, le=100)]  # m
Name = Annotated[str, Field(min_length=1, max_length=200)]

# Most of a house; the largest have tens.
HOUSE_ROOMS, HOUSE_WALLS, HOUSE_HOLES, HOUSE_OBJECTS, HOUSE_CORNERS = 200, 5000, 500, 5000, 1000


class _Read(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Vector(_Read):
    """Hold a point x, y, z, m."""

    x: Coordinate
    y: Coordinate
    z: Coordinate


class Angles(_Read):
    """Hold rotations about x, y, z, degrees."""

    x: Angle
    y: Angle
    z: Angle


class Extents(_Read):
    """Hold the full size along x, y, z, m."""

    x: Extent
    y: Extent
    z: Extent


class Color(_Read):
    """Hold red, green, blue."""

    r: float
    g: float
    b: float


class SurfaceMaterial(_Read):
    """Hold a Unity material by name, with a colour of its own or not."""

    name: Annotated[str, Field(max_length=200)]
    color: Color | None = None


class HouseRoom(_Read):
    """Hold a room and the outline of its floor."""

    id: Name
    roomType: Name
    floorPolygon: tuple[Vector, ...] = Field(min_length=3, max_length=HOUSE_CORNERS)
    floorMaterial: SurfaceMaterial


class HouseWall(_Read):
    """Hold one face of a wall: four corners, a lower and an upper pair; the exterior's faces list the upper first."""

    id: Name
    roomId: Name
    polygon: tuple[Vector, ...] = Field(min_length=4, max_length=4)
    material: SurfaceMaterial


class Hole(_Read):
    """Hold a door or window: two corners in the frame of ``wall0`` (x along it, y up) and the faces on either side."""

    id: Name
    wall0: Name
    wall1: Name
    room0: Name
    room1: Name
    holePolygon: tuple[Vector, ...] = Field(min_length=2, max_length=2)
    openness: Openness | None = None


class HouseObject(_Read):
    """Hold an object: the centre of its asset's box, rotation in degrees, and the objects on or in it."""

    id: Name
    assetId: Name
    position: Vector
    rotation: Angles
    children: tuple["HouseObject", ...] = Field((), max_length=HOUSE_OBJECTS)


class Parameters(_Read):
    """Hold the ceiling's material; lights and the sky are not used."""

    ceilingMaterial: SurfaceMaterial = SurfaceMaterial(name="PureWhite")


class Metadata(_Read):
    """Hold ``warnings``, which maps a warning's name to its sentence."""

    warnings: dict[str, Any] | None = None


class House(_Read):
    """Hold a ProcTHOR house."""

    rooms: tuple[HouseRoom, ...] = Field(min_length=1, max_length=HOUSE_ROOMS)
    walls: tuple[HouseWall, ...] = Field(min_length=1, max_length=HOUSE_WALLS)
    doors: tuple[Hole, ...] = Field((), max_length=HOUSE_HOLES)
    windows: tuple[Hole, ...] = Field((), max_length=HOUSE_HOLES)
    objects: tuple[HouseObject, ...] = Field((), max_length=HOUSE_OBJECTS)
    metadata: Metadata = Metadata()
    proceduralParameters: Parameters = Parameters()


class Asset(_Read):
    """Hold a mesh's name, type and full extents (Unity axes, m)."""

    assetId: Name
    objectType: Name
    boundingBox: Extents
