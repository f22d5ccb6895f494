"""Define a furnished apartment as data: rooms, walls with thickness, doors, windows and furniture made of boxes.

World frame: z up, metres, radians; the finished floor is z = 0. `parse_apartment` turns plain data into an
`Apartment` and reports the first thing wrong with it as one `InputError` that names the source and the field.
"""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from vssm_gym.envs.scenes.apartment_parts import ROUNDING, Door, Furniture, Material, Positive, Room, Wall, Window
from vssm_gym.envs.scenes.content_hash import content_hash
from vssm_gym.envs.scenes.solids import SolidBox, solid_boxes
from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError

MAX_EXTENT = 250.0  # m, largest apartment
MOST_ROOMS, MOST_WALLS, MOST_HOLES, MOST_PIECES = 1000, 20_000, 5000, 20_000  # most of one apartment
LEAST_FLOOR = 1.0  # m^2 of floor that an imported scene has


class Apartment(StrictModel):
    """Hold a whole apartment; see the fields' own types for frames and units.

    ``ceiling_height`` m is the ceiling's underside. ``notes`` are sentences for the user on the origin of the scene
    (warnings of the file it was imported from, approximations); they are not part of the content hash. ``format`` is
    the version of the JSON format; a file of another version is refused.
    """

    format: Literal[1] = 1
    name: str = Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$")  # files are named after it
    rooms: tuple[Room, ...] = Field(min_length=1, max_length=MOST_ROOMS)
    walls: tuple[Wall, ...] = Field(min_length=1, max_length=MOST_WALLS)
    doors: tuple[Door, ...] = Field((), max_length=MOST_HOLES)
    windows: tuple[Window, ...] = Field((), max_length=MOST_HOLES)
    furniture: tuple[Furniture, ...] = Field((), max_length=MOST_PIECES)
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
        """Return everything solid as upright boxes.

        Floor, ceiling, walls around their holes, leaves, panes, furniture.
        """
        return solid_boxes(self)

    def content_hash(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of the canonical JSON without ``notes``."""
        return content_hash(self, without="notes")


def _check_extent(apartment: Apartment) -> None:
    for field, shapes in (
        ("rooms", [room.polygon for room in apartment.rooms]),
        ("walls", [(wall.start, wall.end) for wall in apartment.walls]),
    ):
        for axis in range(2):
            values = [point[axis] for shape in shapes for point in shape]
            if max(values) - min(values) > MAX_EXTENT:
                expected = f"at most {MAX_EXTENT:g} m across; found {max(values) - min(values):.1f}"
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
    """Check that every door and window lies inside its wall and that no two overlap."""
    taken: dict[int, list[tuple[float, float, str]]] = {}
    holes: list[tuple[str, Door | Window]] = [(f"doors[{i}]", door) for i, door in enumerate(apartment.doors)]
    holes += [(f"windows[{i}]", window) for i, window in enumerate(apartment.windows)]
    for field, hole in holes:
        if hole.wall >= len(apartment.walls):
            expected = f"an index below {len(apartment.walls)}, the number of walls; found {hole.wall}"
            raise InputError(apartment.name, f"{field}.wall", expected)
        wall = apartment.walls[hole.wall]
        start, end = hole.offset, hole.offset + hole.width
        if end > wall.length + ROUNDING:
            expected = f"offset + width within the wall's {wall.length:.3f} m; found {end:.3f}"
            raise InputError(apartment.name, f"{field}.offset", expected)
        if hole.sill + hole.height > wall.height + ROUNDING:
            expected = f"a top within the wall's {wall.height:.3f} m; found {hole.sill + hole.height:.3f}"
            raise InputError(apartment.name, f"{field}.height", expected)
        for other_start, other_end, other in taken.setdefault(hole.wall, []):
            if start < other_end - ROUNDING and other_start < end - ROUNDING:
                raise InputError(apartment.name, f"{field}.offset", f"a hole that does not overlap {other}")
        taken[hole.wall].append((start, end, field))


def parse_apartment(data: Any, source: object) -> Apartment:
    """Return the `Apartment` that plain JSON data describes.

    Raise InputError naming ``source`` and the first bad field.
    """
    return validated(Apartment, data, source)
