"""Import ProcTHOR houses (Deitke et al., 2022): walls, doors by openness, objects as boxes of their assets.

Unity's frame is left-handed, so p_world = (x, z, y) and yaw = -rotation.y. The source's walls are planes without
thickness, one face a room: the faces of one wall become one `Wall`, WALL_THICKNESS thick around their plane, each side
with its own material.

A hole's x runs from the first lower corner of ``wall0``. Evidence: of the 105 doors and windows of forty-three
houses (three of 3-4 rooms, forty of one room) 99 are off the wall's centre; measured from the first
corner, the clearance in front of the hole is free of objects for 98 of them, measured from the second for 45, and in no
case for the second but not for the first (`tests/envs/scenes/test_procthor.py` counts again). ``assetPosition.x`` lies
inside the hole in that frame in all 105, and ``wall1`` always lists the corners of ``wall0`` in reverse.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import XY, Door, Furniture, Material, Room, Wall, Window
from vssm_gym.envs.scenes.faults import misplaced, open_edges, with_notes
from vssm_gym.envs.scenes.importers.procthor_format import Asset, Hole, House, HouseWall, SurfaceMaterial, Vector
from vssm_gym.envs.scenes.importers.procthor_looks import RGB, surface_material
from vssm_gym.envs.scenes.importers.procthor_objects import furniture_of
from vssm_gym.envs.scenes.solids import door_leaves, footprint
from vssm_gym.envs.validation import validated
from vssm_gym.errors import InputError

WALL_THICKNESS = 0.1  # m, of every wall
DOUBLE_DOOR = 1.4  # m, the hole's width from which two leaves share it

_KINDS = {"LivingRoom": "living room"}


def is_procthor(data: Any) -> bool:
    """Return True if JSON data looks like a ProcTHOR house, whole or damaged."""
    if not isinstance(data, dict):
        return False
    rooms = data.get("rooms")
    floors = isinstance(rooms, list) and any(isinstance(room, dict) and "floorPolygon" in room for room in rooms)
    return floors or "proceduralParameters" in data


def asset_database_of(path: Path) -> Path:
    """Return ``asset-database.json`` beside the house or one folder up; raise InputError where neither exists."""
    for folder in (path.parent, path.parent.parent):
        if (folder / "asset-database.json").is_file():
            return folder / "asset-database.json"
    raise InputError(
        path, "asset-database.json", "this file beside the house or one folder up: objects take their sizes from it"
    )


def read_assets(data: Any, source: object) -> dict[str, Asset]:
    """Return assets by id from the parsed database, a mapping from type to a list of assets."""
    if not isinstance(data, dict) or not all(isinstance(entries, list) for entries in data.values()):
        raise InputError(source, "content", "a JSON object that maps an object type to a list of assets")
    assets = [validated(Asset, entry, source) for entries in data.values() for entry in entries]
    return {asset.assetId: asset for asset in assets}


def import_procthor(data: Any, assets: Mapping[str, Asset], name: str, source: object) -> Apartment:
    """Return the `Apartment` of a parsed ProcTHOR house.

    Args:
        data: the parsed JSON of the house.
        assets: sizes and types by asset id, from `read_assets`.
        name: the apartment's name.
        source: what errors name, usually the path.

    Raises:
        InputError: a field is missing or wrong, an asset is not in the database, or a hole does not fit its wall.
    """
    house = validated(House, data, source)
    notes = [f"{key}: {text}"[:300] for key, text in list((house.metadata.warnings or {}).items())[:20]]
    names = {room.id: f"{room.roomType} ({room.id})" for room in house.rooms}
    rooms = [
        validated(
            Room,
            {
                "name": names[room.id],
                "kind": _KINDS.get(room.roomType, room.roomType.lower()),
                "polygon": _without_repeats([_xy(corner) for corner in room.floorPolygon]),
                "floor": _surface(room.floorMaterial, "floor"),
            },
            source,
            at=f"rooms[{i}]",
        )
        for i, room in enumerate(house.rooms)
    ]
    outlines = {room.id: shapely.Polygon(made.polygon) for room, made in zip(house.rooms, rooms, strict=True)}
    walls, faces = _walls(house, outlines, source)
    furniture = furniture_of(house, assets, walls, source, notes)
    ceiling = max(wall.base + wall.height for wall in walls)
    doors = [_door(f"doors[{i}]", hole, names, walls, faces, furniture, source) for i, hole in enumerate(house.doors)]
    windows = [
        validated(Window, _hole(f"windows[{i}]", hole, walls, faces, source), source, at=f"windows[{i}]")
        for i, hole in enumerate(house.windows)
    ]
    content = {
        "name": name,
        "rooms": rooms,
        "walls": walls,
        "doors": doors,
        "windows": windows,
        "furniture": furniture,
        "ceiling_height": ceiling,
        "ceiling": _surface(house.proceduralParameters.ceilingMaterial, "ceiling"),
        "notes": notes,
    }
    return with_notes(validated(Apartment, content, source), open_edges, misplaced)


def _xy(p: Vector) -> XY:
    return (p.x, p.z)


def _without_repeats(points: list[XY]) -> tuple[XY, ...]:
    return tuple(p for p, before in zip(points, [points[-1], *points[:-1]], strict=True) if math.dist(p, before) > 1e-6)


def _surface(surface: SurfaceMaterial, where: Literal["wall", "floor", "ceiling"]) -> Material:
    color: RGB | None = None
    if surface.color is not None:
        red, green, blue = (min(max(c, 0.0), 1.0) for c in (surface.color.r, surface.color.g, surface.color.b))
        color = (red, green, blue)
    return surface_material(surface.name, color, where)


def _lower_corners(wall: HouseWall) -> tuple[XY, XY]:
    """Return the wall's lower corners in the file's order (the exterior's faces list their upper pair first)."""
    low = sorted(wall.polygon, key=lambda p: p.y)[:2]
    first, second = (p for p in wall.polygon if any(p is q for q in low))
    return _xy(first), _xy(second)


def _walls(
    house: House, outlines: Mapping[str, shapely.Polygon], source: object
) -> tuple[list[Wall], dict[str, tuple[int, bool]]]:
    """Merge the faces that share both corners into walls; return each face's (wall index, same direction) by id too."""
    groups: dict[frozenset[tuple[int, int]], list[int]] = defaultdict(list)
    for i, face in enumerate(house.walls):
        groups[frozenset((round(x * 1000), round(y * 1000)) for x, y in _lower_corners(face))].append(i)
    walls: list[Wall] = []
    faces: dict[str, tuple[int, bool]] = {}
    for corners, members in groups.items():
        first = house.walls[members[0]]
        if len(corners) < 2:
            raise InputError(source, f"walls[{members[0]}].polygon", "two lower corners more than 1 mm apart")
        start, end = _lower_corners(first)
        looks: dict[str, Material] = {}
        for i in members:
            face = house.walls[i]
            if face.roomId not in outlines:
                raise InputError(source, f"walls[{i}].roomId", f"a room's id; found {face.roomId!r}")
            # A face belongs to the side its room is on, the exterior's to the other one.
            inward = _room_on_left(start, end, outlines[face.roomId])
            looks["front" if inward != ("exterior" in face.id) else "back"] = _surface(face.material, "wall")
            faces[face.id] = (len(walls), math.dist(_lower_corners(face)[0], start) < 1e-3)
        heights = [p.y for i in members for p in house.walls[i].polygon]
        front = looks.get("front") or looks["back"]
        shape = {
            "start": start,
            "end": end,
            "thickness": WALL_THICKNESS,
            "base": min(heights),
            "height": max(heights) - min(heights),
            "front": front,
            "back": looks.get("back") or front,
        }
        walls.append(validated(Wall, shape, source, at=f"walls[{members[0]}]"))
    return walls, faces


def _room_on_left(start: XY, end: XY, outline: shapely.Polygon) -> bool:
    length = math.dist(start, end)
    left = (-(end[1] - start[1]) / length * 0.02, (end[0] - start[0]) / length * 0.02)
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    return bool(shapely.contains_xy(outline, middle[0] + left[0], middle[1] + left[1]))


def _hole(
    field: str, hole: Hole, walls: list[Wall], faces: Mapping[str, tuple[int, bool]], source: object
) -> dict[str, Any]:
    """Return wall, offset, width, height and sill of a hole; its x runs from the first lower corner of ``wall0``."""
    if hole.wall0 not in faces:
        raise InputError(source, f"{field}.wall0", f"a wall's id; found {hole.wall0!r}")
    index, forward = faces[hole.wall0]
    if faces.get(hole.wall1, (index,))[0] != index:  # its other face would stay closed
        raise InputError(source, f"{field}.wall1", f"the other face of {hole.wall0!r}, with the same corners")
    (x0, x1), (y0, y1) = (sorted(getattr(p, axis) for p in hole.holePolygon) for axis in "xy")
    length = walls[index].length
    if x0 < -0.05 or x1 > length + 0.05:
        raise InputError(
            source, f"{field}.holePolygon", f"x within the wall's {length:.3f} m; found {x0:.3f} to {x1:.3f}"
        )
    x0, x1 = max(x0, 0.0), min(x1, length)  # files round to millimetres
    offset = x0 if forward else length - x1
    return {"wall": index, "offset": max(offset, 0.0), "width": x1 - x0, "height": y1 - y0, "sill": max(y0, 0.0)}


def _door(
    field: str,
    hole: Hole,
    names: Mapping[str, str],
    walls: list[Wall],
    faces: Mapping[str, tuple[int, bool]],
    furniture: list[Furniture],
    source: object,
) -> Door:
    """Return a doorway where the file gives no openness, else one leaf, or two in a wide hole, at that openness."""
    place = _hole(field, hole, walls, faces, source)
    place["height"] += place.pop("sill")  # the hole starts at the floor
    for key in ("room0", "room1"):
        if getattr(hole, key) not in names:
            raise InputError(source, f"{field}.{key}", f"a room's id; found {getattr(hole, key)!r}")
    other = None if "exterior" in hole.wall1 else names[hole.room1]
    leaves = 0 if hole.openness is None else 2 if place["width"] >= DOUBLE_DOOR else 1
    place |= {"rooms": (names[hole.room0], other), "openness": hole.openness or 0.0, "leaves": leaves}
    door = validated(Door, place, source, at=field)
    return door if not leaves or not door.openness else _swung_clear(door, walls, furniture)


def _swung_clear(door: Door, walls: list[Wall], furniture: list[Furniture]) -> Door:
    """Hinge and swing the door so that its leaves cover the least furniture and wall; the file does not say how."""
    solid = [
        footprint(box) for piece in furniture for box in piece.boxes if box.center[2] - box.size[2] / 2 < door.height
    ]
    solid += [
        shapely.LineString([wall.start, wall.end]).buffer(wall.thickness / 2, cap_style="flat")
        for i, wall in enumerate(walls)
        if i != door.wall
    ]
    blocked = shapely.union_all(solid)
    choices = [
        door.model_copy(update={"swing": swing, "hinge": hinge})
        for swing in ("front", "back")
        for hinge in (("start", "end") if door.leaves == 1 else ("start",))
    ]
    covered = [
        sum(blocked.intersection(footprint(leaf)).area for leaf in door_leaves("", walls[door.wall], choice))
        for choice in choices
    ]
    return choices[int(np.argmin(np.round(covered, 4)))]
