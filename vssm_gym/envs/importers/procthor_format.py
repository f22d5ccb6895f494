"""The parts of a ProcTHOR house (schema 1.0.0) and of its asset database that the importer reads, as typed data.

Unity's frame: left-handed, y up, metres, degrees. Fields that the importer does not read are ignored.
"""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Openness = Annotated[float, Field(ge=0, le=1)]


class _Read(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Vector(_Read):
    """x, y, z: a point in m, angles in degrees or extents in m."""

    x: float
    y: float
    z: float


class Color(_Read):
    """Red, green, blue."""

    r: float
    g: float
    b: float


class Surface(_Read):
    """A Unity material by name, with a colour of its own or not."""

    name: str
    color: Color | None = None


class HouseRoom(_Read):
    """A room and the outline of its floor."""

    id: str
    roomType: str
    floorPolygon: tuple[Vector, ...] = Field(min_length=3)
    floorMaterial: Surface


class HouseWall(_Read):
    """One face of a wall: four corners, a lower and an upper pair; the exterior's faces list the upper first."""

    id: str
    roomId: str
    polygon: tuple[Vector, ...] = Field(min_length=4, max_length=4)
    material: Surface


class Hole(_Read):
    """A door or window: two corners in the frame of ``wall0`` (x along it, y up) and the faces on either side."""

    id: str
    wall0: str
    wall1: str
    room0: str
    room1: str
    holePolygon: tuple[Vector, ...] = Field(min_length=2, max_length=2)
    openness: Openness | None = None


class HouseObject(_Read):
    """An object: the centre of its asset's box, rotation in degrees, and what stands on or in it."""

    id: str
    assetId: str
    position: Vector
    rotation: Vector
    children: tuple["HouseObject", ...] = ()


class Parameters(_Read):
    """The ceiling's material; lights and the sky are not used."""

    ceilingMaterial: Surface = Surface(name="PureWhite")


class Metadata(_Read):
    """``warnings`` maps a warning's name to its sentence."""

    warnings: dict[str, Any] | None = None


class House(_Read):
    """A ProcTHOR house."""

    rooms: tuple[HouseRoom, ...] = Field(min_length=1)
    walls: tuple[HouseWall, ...] = Field(min_length=1)
    doors: tuple[Hole, ...] = ()
    windows: tuple[Hole, ...] = ()
    objects: tuple[HouseObject, ...] = ()
    metadata: Metadata = Metadata()
    proceduralParameters: Parameters = Parameters()


class Asset(_Read):
    """A mesh's name, type and full extents (Unity axes, m)."""

    assetId: str
    objectType: str
    boundingBox: Vector
