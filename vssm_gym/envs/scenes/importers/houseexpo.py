"""Import HouseExpo floor plans (Li et al., 2019): the outline of the free space is cut into rooms at its doors.

A plan is one polygon around all free space, inner walls included. Everything inside is floor and everything outside is
wall, so that the simulator's free space is the polygon (chamfers of 1 cm at its corners are squared). The file has no
doors: a doorway with a lintel is put where the polygon narrows between two wider parts
(`vssm_gym.envs.scenes.importers.plan_rooms`). The boxes of ``room_category`` overlap and are no walls: they name the
rooms.
"""

import math
from collections import defaultdict
from typing import Annotated, Any

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field, field_validator
from shapely import Polygon

from vssm_gym.envs.scenes.apartment import LEAST_FLOOR, Apartment
from vssm_gym.envs.scenes.apartment_parts import (
    CEILING_HEIGHT,
    DOOR_HEIGHT,
    Coordinate,
    Door,
    Furniture,
    Material,
    Room,
    Wall,
)
from vssm_gym.envs.scenes.importers.plan_looks import WALL_PICTURE, floor_material, picture, wall_material
from vssm_gym.envs.scenes.importers.plan_rooms import Opening, split_rooms
from vssm_gym.envs.scenes.importers.plan_walls import Face, square_corners, wall_faces
from vssm_gym.envs.validation import validated
from vssm_gym.errors import InputError

LARGEST_PLAN = 100.0  # m, extent of a plan
LEAST_OVERLAP = 0.25  # least overlap (intersection over union) of a room with a category's box
PICTURE_WALL = 1.4  # m, shortest wall that carries a picture
PLAN_CORNERS = 1000  # of an outline; the plans of the data set have a few hundred at most
PLAN_WALLS = 1000  # pieces of walls
PLAN_BOXES = 300  # of all categories; the largest plans have 60 rooms
FAR_BOX = 1e5  # m; boxes of categories may lie far outside the plan

_Corner = tuple[Coordinate, Coordinate]
_Box = tuple[Annotated[float, Field(ge=-FAR_BOX, le=FAR_BOX)], ...]
_Boxes = tuple[Annotated[_Box, Field(min_length=4, max_length=4)], ...]


class HouseExpoPlan(BaseModel):
    """Hold the fields that are read of a HouseExpo file."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    verts: tuple[_Corner, ...] = Field(min_length=3, max_length=PLAN_CORNERS)
    room_category: dict[str, _Boxes] = {}

    @field_validator("room_category")
    @classmethod
    def _bounded(cls, categories: dict[str, _Boxes]) -> dict[str, _Boxes]:
        if len(categories) > PLAN_BOXES or sum(map(len, categories.values())) > PLAN_BOXES:
            raise ValueError(f"at most {PLAN_BOXES} boxes")
        return categories


def is_houseexpo(data: Any) -> bool:
    """Return True if JSON data looks like a HouseExpo plan, whole or damaged."""
    return isinstance(data, dict) and "rooms" not in data and bool({"verts", "room_category"} & data.keys())


def import_houseexpo(data: Any, name: str, source: object) -> Apartment:
    """Return the `Apartment` of a parsed HouseExpo plan; raise InputError naming ``source`` and the wrong field."""
    plan = validated(HouseExpoPlan, data, source)
    notes: list[str] = []
    outline = _outline(plan, source, notes)
    parts, openings = split_rooms(outline)
    kinds = [_kind(part, plan) for part in parts]
    notes += _stray_categories(plan, outline)
    names = _numbered([kind.capitalize() for kind in kinds])
    rooms: list[Room] = []
    walls: list[Wall] = []
    furniture: list[Furniture] = []
    for part, kind, room in zip(parts, kinds, names, strict=True):
        corners = [(float(x), float(y)) for x, y in shapely.get_coordinates(part.exterior)[:-1]]
        content = {"name": room, "kind": kind, "polygon": corners, "floor": floor_material(kind, room)}
        rooms.append(validated(Room, content, source, at="verts"))
        try:
            faces = wall_faces(part, outline, PLAN_WALLS - len(walls))
        except ValueError as error:
            expected = f"an outline with at most {PLAN_WALLS:,} pieces of walls, each as thick as what is behind it"
            raise InputError(source, "verts", expected) from error
        for face in faces:
            furniture += _picture(face, part, len(walls))
            walls.append(_wall(face, wall_material(kind, room)))
    doors = [_doorway(opening, parts, names, walls) for opening in openings]
    if doors:
        notes.append(f"the file has no doors: open doorways stand where the plan is narrow ({len(doors)})")
    content = {
        "name": name,
        "rooms": rooms,
        "walls": walls,
        "doors": doors,
        "furniture": furniture,
        "ceiling_height": CEILING_HEIGHT,
        "notes": notes,
    }
    return validated(Apartment, content, source)


def _outline(plan: HouseExpoPlan, source: object, notes: list[str]) -> Polygon:
    corners = np.array(plan.verts)
    extent = float(np.ptp(corners, axis=0).max())
    if extent > LARGEST_PLAN:
        raise InputError(source, "verts", f"a plan of at most {LARGEST_PLAN:g} m; found {extent:.1f}")
    outline = Polygon(corners)
    if not outline.is_valid:  # an outline that touches itself bounds one polygon all the same
        reason = shapely.is_valid_reason(outline)
        parts = shapely.get_parts(shapely.make_valid(outline))
        largest = max(parts, key=lambda part: part.area)
        area = sum(part.area for part in parts)
        if not isinstance(largest, Polygon) or largest.interiors or largest.area < 0.98 * area or area == 0.0:
            raise InputError(source, "verts", f"a simple polygon; found {reason}")
        notes.append(f"the outline was repaired: {reason}")
        outline = largest
    if outline.area < LEAST_FLOOR:
        raise InputError(source, "verts", f"an outline of at least {LEAST_FLOOR:g} m^2; found {outline.area:.3f}")
    return square_corners(shapely.orient_polygons(outline))


def _kind(part: Polygon, plan: HouseExpoPlan) -> str:
    """Return the category whose box overlaps the room most; "room" where none does."""
    best, most = "room", LEAST_OVERLAP
    for category, boxes in plan.room_category.items():
        for x0, y0, x1, y1 in boxes:
            box = shapely.box(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))
            overlap = part.intersection(box).area / max(part.union(box).area, 1e-9)
            if overlap > most:
                best, most = category.replace("_", " ").strip().lower()[:40] or "room", overlap
    return best


def _stray_categories(plan: HouseExpoPlan, outline: Polygon) -> list[str]:
    """Return a sentence for each category whose boxes all lie outside the plan or have no area: it can name no room."""
    stray = []
    for category, boxes in plan.room_category.items():
        shapes = [shapely.box(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)) for x0, y0, x1, y1 in boxes]
        if shapes and all(shape.intersection(outline).area == 0.0 for shape in shapes):
            stray.append(f"room_category {category[:40]!r} has no box on the plan: it names no room")
    return stray


def _numbered(words: list[str]) -> list[str]:
    """Return the words, each unique: the second "Bedroom" is "Bedroom 2"."""
    used: dict[str, int] = defaultdict(int)
    names: list[str] = []
    for word in words:
        used[word] += 1
        names.append(word if used[word] == 1 else f"{word} {used[word]}")
    return names


def _wall(face: Face, material: Material) -> Wall:
    middle = -0.5 * face.thickness * face.inward
    (x0, y0), (x1, y1) = (face.start + middle).tolist(), (face.end + middle).tolist()
    return Wall(
        start=(x0, y0), end=(x1, y1), thickness=face.thickness, height=CEILING_HEIGHT, front=material, back=material
    )


def _picture(face: Face, room: Polygon, number: int) -> list[Furniture]:
    """Return a picture in the middle of a long wall; one long wall in five stays bare."""
    length = float(np.linalg.norm(face.end - face.start))
    width = min(WALL_PICTURE[0], 0.4 * length)
    if length < PICTURE_WALL or number % 5 == 4:
        return []
    x, y = (face.start + face.end) / 2 + 0.5 * WALL_PICTURE[2] * face.inward
    hung = picture(f"picture {number}", float(x), float(y), math.atan2(face.along[1], face.along[0]), width)
    return [hung] if room.contains(shapely.Point(x, y).buffer(0.02)) or room.contains(shapely.Point(x, y)) else []


def _doorway(opening: Opening, parts: list[Polygon], names: list[str], walls: list[Wall]) -> Door:
    """Return an open doorway in a wall of its own, as long as the opening is wide.

    The wall is appended to ``walls``.
    """
    middle = np.mean([opening.start, opening.end], axis=0)
    material = wall_material("", "lintel")
    thickness = max(opening.thickness, 0.04)
    walls.append(
        Wall(
            start=opening.start,
            end=opening.end,
            thickness=thickness,
            height=CEILING_HEIGHT,
            front=material,
            back=material,
        )
    )
    near = np.argsort([part.distance(shapely.Point(middle)) for part in parts], kind="stable")
    return Door(
        wall=len(walls) - 1,
        offset=0.0,
        width=opening.width,
        height=DOOR_HEIGHT,
        leaves=0,
        rooms=(names[near[0]], names[near[1]]),
    )
