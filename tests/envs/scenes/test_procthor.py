"""Test the ProcTHOR importer: a small house whose numbers one can compute by hand, laws, and the real houses."""

import copy
import gzip
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.paths import SHARED_DATA
from vssm_gym.envs.scenes.importers.procthor import import_procthor, read_assets
from vssm_gym.envs.scenes.importers.procthor_format import Asset
from vssm_gym.envs.scenes.importers.procthor_looks import object_material, surface_material
from vssm_gym.envs.scenes.scene import Apartment, Wall, load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.errors import InputError

DATA = SHARED_DATA / "procthor"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the procthor files are not on this machine")


def vec(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def face(name: str, room: str, a: tuple, b: tuple, material: dict, upper_first: bool = False) -> dict[str, Any]:
    low, high = ([vec(p[0], y, p[1]) for p in (a, b)] for y in (0, 3.0))
    polygon = high + low if upper_first else low + high
    return {"id": name, "roomId": room, "polygon": polygon, "material": material}


def small_house() -> dict[str, Any]:
    """Two rooms side by side: A is x 0..4, B is x 4..6, both z 0..3. A half open door between them, 0.5 m from the end
    z = 3 of its wall as room A lists it, a window to the outside, a table with a cup, a picture 5 mm off a wall."""
    blue, red = {"name": "PureWhite", "color": {"r": 0.2, "g": 0.3, "b": 0.9}}, {"name": "RedBricks 1"}
    tiles = {"name": "CeramicTiles1"}
    return {
        "rooms": [
            {
                "id": "room|1",
                "roomType": "LivingRoom",
                "floorPolygon": [vec(0, 0, 0), vec(0, 0, 3), vec(4, 0, 3), vec(4, 0, 0)],
                "floorMaterial": {"name": "WoodFloorsCross"},
            },
            {
                "id": "room|2",
                "roomType": "Bedroom",
                "floorPolygon": [vec(4, 0, 0), vec(4, 0, 3), vec(6, 0, 3), vec(6, 0, 0)],
                "floorMaterial": {"name": "KitchenTiles3"},
            },
        ],
        "walls": [
            face("wall|1|a", "room|1", (0, 0), (0, 3), blue),
            face("wall|1|b", "room|1", (0, 3), (4, 3), blue),
            face("wall|1|c", "room|1", (4, 3), (4, 0), blue),
            face("wall|1|d", "room|1", (4, 0), (0, 0), blue),
            face("wall|2|a", "room|2", (4, 0), (4, 3), tiles),
            face("wall|2|b", "room|2", (4, 3), (6, 3), tiles),
            face("wall|2|c", "room|2", (6, 3), (6, 0), tiles),
            face("wall|2|d", "room|2", (6, 0), (4, 0), tiles),
            face("wall|exterior|a", "room|1", (0, 3), (0, 0), red, upper_first=True),
        ],
        "doors": [
            {
                "id": "door|1|2",
                "wall0": "wall|1|c",
                "wall1": "wall|2|a",
                "room0": "room|1",
                "room1": "room|2",
                "holePolygon": [vec(0.5, 0, 0), vec(1.5, 2.0, 0)],
                "openness": 0.5,
            }
        ],
        "windows": [
            {
                "id": "window|1",
                "wall0": "wall|1|a",
                "wall1": "wall|exterior|a",
                "room0": "room|1",
                "room1": "room|1",
                "holePolygon": [vec(0.25, 1.0, 0), vec(1.25, 2.2, 0)],
            }
        ],
        "objects": [
            {
                "id": "table",
                "assetId": "Table_1",
                "position": vec(2, 0.4, 1),
                "rotation": vec(0, 30, 0),
                "children": [
                    {"id": "cup", "assetId": "Cup_1", "position": vec(2.1, 0.86, 1.2), "rotation": vec(0, 0, 0)}
                ],
            },
            {"id": "picture", "assetId": "Picture_1", "position": vec(2, 1.5, 2.985), "rotation": vec(0, 180, 0)},
        ],
        "metadata": {"warnings": {"RoomsNotNavigable": "Rooms [2] / 2 are not navigable."}},
        "proceduralParameters": {"ceilingMaterial": {"name": "PureWhite"}},
    }


ASSETS = read_assets(
    {
        "DiningTable": [{"assetId": "Table_1", "objectType": "DiningTable", "boundingBox": vec(1.6, 0.8, 0.9)}],
        "Cup": [{"assetId": "Cup_1", "objectType": "Cup", "boundingBox": vec(0.1, 0.12, 0.08)}],
        "Painting": [{"assetId": "Picture_1", "objectType": "Painting", "boundingBox": vec(0.8, 0.6, 0.02)}],
    },
    "assets",
)


def imported(house: dict[str, Any]) -> Apartment:
    return import_procthor(house, ASSETS, "small", "small.json")


def test_the_small_house_by_hand() -> None:
    flat = imported(small_house())
    assert [room.name for room in flat.rooms] == ["LivingRoom (room|1)", "Bedroom (room|2)"]
    assert [room.kind for room in flat.rooms] == ["living room", "bedroom"]
    assert flat.rooms[1].polygon == ((4, 0), (4, 3), (6, 3), (6, 0))  # (x, z)
    assert flat.rooms[0].floor.texture == "parquet" and flat.rooms[1].floor.texture == "tiles"
    assert flat.ceiling_height == 3.0
    assert flat.notes == ("RoomsNotNavigable: Rooms [2] / 2 are not navigable.",)

    assert len(flat.walls) == 7  # nine faces, two of which are the other side of another
    left, shared = flat.walls[0], flat.walls[2]
    assert (left.start, left.end, left.thickness, left.height) == ((0, 0), (0, 3), 0.1, 3.0)
    # (0,0) -> (0,3) points to +y: its left is x < 0, outside
    assert left.front.texture == "brick" and left.back.color == (0.2, 0.3, 0.9)
    # (4,3) -> (4,0) points to -y: its left is x > 4, the bedroom
    assert shared.front.texture == "tiles" and shared.back.texture == "plaster"

    (door,) = flat.doors
    assert (door.wall, door.width, door.height, door.openness, door.leaves) == (2, 1.0, 2.0, 0.5, 1)
    assert door.offset == 0.5  # from (4, 3), where room A's face starts: the hole is y 1.5 .. 2.5
    assert door.rooms == ("LivingRoom (room|1)", "Bedroom (room|2)")
    (window,) = flat.windows
    assert (window.wall, window.offset, window.width, window.height, window.sill) == pytest.approx((0, 0.25, 1, 1.2, 1))

    table, cup, picture = flat.furniture
    assert (table.name, table.category, cup.category) == ("table", "DiningTable", "Cup")
    assert table.boxes[0].center == (2, 1, 0.4) and table.boxes[0].size == (1.6, 0.9, 0.8)
    assert table.boxes[0].yaw == pytest.approx(-math.radians(30))
    assert cup.boxes[0].center == (2.1, 1.2, 0.86)
    # The picture's back was 5 mm off the wall's plane; it is now 5 mm off the wall's face, 50 mm further in.
    assert picture.boxes[0].center == pytest.approx((2, 2.935, 1.5))
    assert picture.boxes[0].material.texture.startswith("painting")


@pytest.mark.parametrize(
    ("openness", "width", "leaves"), [(None, 1.0, 0), (0.0, 1.0, 1), (1.0, 1.0, 1), (1.0, 2.0, 2), (0.3, 2.0, 2)]
)
def test_doors_by_openness(openness: float | None, width: float, leaves: int) -> None:
    house = small_house()
    house["doors"][0]["holePolygon"][1]["x"] = 0.5 + width
    house["doors"][0]["openness"] = openness
    flat = imported(house)
    assert flat.doors[0].leaves == leaves
    boxes = [
        footprint(box) for box in flat.boxes() if box.kind in ("wall", "door") and box.center[2] - box.size[2] / 2 < 1
    ]
    crossing = shapely.LineString([(3.9, 2.5 - width / 4), (4.1, 2.5 - width / 4)])
    assert any(crossing.intersects(box) for box in boxes) == (openness == 0.0)


def test_a_leaf_swings_to_the_side_with_room_for_it() -> None:
    house = small_house()
    house["doors"][0]["openness"] = 1.0
    house["objects"] = []
    for x, swing in ((3.4, "front"), (4.6, "back")):  # a table on one side of the door, then on the other
        house["objects"] = [{"id": "t", "assetId": "Table_1", "position": vec(x, 0.4, 2.0), "rotation": vec(0, 90, 0)}]
        assert imported(house).doors[0].swing == swing


def test_a_door_outside_has_one_room() -> None:
    house = small_house()
    house["doors"][0] |= {"wall0": "wall|1|a", "wall1": "wall|exterior|a", "room1": "room|1", "openness": 0}
    house["windows"] = []
    assert imported(house).doors[0].rooms == ("LivingRoom (room|1)", None)


# ---- laws


def unity_corners(size: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(8, 3) corners in the world, straight from Unity's definition: R = Ry Rx Rz in its left-handed frame, then
    (x, y, z) -> (x, z, y). Unity's yaw by 90 degrees takes +z to +x."""
    x, y, z = np.radians(rotation)
    rx = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    ry = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    rz = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    local = np.array([(i, j, k) for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * size
    return (local @ (ry @ rx @ rz).T + position)[:, [0, 2, 1]]


def one_object(size: list[float], position: list[float], rotation: list[float]) -> Apartment:
    house = small_house()
    house["objects"] = [{"id": "o", "assetId": "O", "position": vec(*position), "rotation": vec(*rotation)}]
    asset = Asset.model_validate({"assetId": "O", "objectType": "Box", "boundingBox": vec(*size)})
    return import_procthor(house, {"O": asset}, "one", "one.json")


sizes = st.lists(st.floats(0.05, 0.5), min_size=3, max_size=3)


@given(sizes, st.floats(-720, 720), st.sampled_from([-90, 0, 90, 180, 270]), st.sampled_from([0, 90, 180]))
@settings(max_examples=60, deadline=None)
def test_boxes_are_exact_for_yaw_and_quarter_turns(size: list[float], yaw: float, x: float, z: float) -> None:
    position = [2.0, 0.7, 1.5]
    (piece,) = one_object(size, position, [x, yaw, z]).furniture
    box = piece.boxes[0]
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    half = np.array([(i, j, k) for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * box.size
    ours = half @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + box.center
    theirs = unity_corners(np.array(size), np.array(position), np.array([x, yaw, z]))
    assert np.linalg.norm(ours[:, None] - theirs[None], axis=-1).min(axis=1).max() < 1e-9
    assert np.linalg.norm(ours[:, None] - theirs[None], axis=-1).min(axis=0).max() < 1e-9


@given(sizes, st.floats(-180, 180), st.floats(-180, 180), st.floats(-180, 180))
@settings(max_examples=60, deadline=None)
def test_a_tilted_object_stays_inside_its_box(size: list[float], yaw: float, x: float, z: float) -> None:
    position = [2.0, 0.7, 1.5]
    flat = one_object(size, position, [x, yaw, z])
    box = flat.furniture[0].boxes[0]
    d = unity_corners(np.array(size), np.array(position), np.array([x, yaw, z])) - box.center
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    local = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=-1)
    # below one degree physics' noise is ignored: 0.5 m * sin(1 deg) is 9 mm
    assert (np.abs(local) <= np.array(box.size) / 2 + 0.015).all()
    tilted = any(abs(math.remainder(angle, 90)) > 1.001 for angle in (x, z))
    assert not tilted or any("tilted" in note for note in flat.notes)


@given(st.permutations(range(9)), st.booleans())
@settings(max_examples=25, deadline=None)
def test_the_order_and_direction_of_faces_do_not_matter(order: list[int], from_other_side: bool) -> None:
    """The same space is solid for every order of the faces and for both sides that may describe the door."""
    house = small_house()
    house["walls"] = [house["walls"][i] for i in order]
    if from_other_side:
        door = house["doors"][0]
        door["wall0"], door["wall1"] = door["wall1"], door["wall0"]
        door["room0"], door["room1"] = door["room1"], door["room0"]
        door["holePolygon"] = [vec(1.5, 0, 0), vec(2.5, 2.0, 0)]
    for hole in house["doors"]:
        hole["openness"] = None

    def outline(flat: Apartment, kind: str, height: float) -> shapely.Geometry:
        boxes = [b for b in flat.boxes() if b.kind == kind and abs(b.center[2] - height) < b.size[2] / 2]
        return shapely.union_all([footprint(box) for box in boxes])

    reference = small_house()
    reference["doors"][0]["openness"] = None
    for kind, height in (("wall", 1.0), ("wall", 2.5), ("window", 1.5)):
        ours, theirs = (outline(imported(h), kind, height) for h in (house, reference))
        assert ours.symmetric_difference(theirs).area < 1e-6


def test_materials_are_deterministic_and_follow_the_names() -> None:
    assert surface_material("Walldrywall3Tiled", None, "wall").texture == "plaster"  # drywall is not a tile
    assert surface_material("SubwayTilesAO", None, "wall").texture == "subway"
    assert surface_material("PureWhite", (0.1, 0.2, 0.3), "wall").color == (0.1, 0.2, 0.3)
    assert surface_material("NeverSeen", None, "floor").texture in ("planks", "laminate")
    assert surface_material("NeverSeen", None, "wall").texture == "plaster"
    assert object_material("Chair_1", "Chair", (0.5, 0.5, 1.0)) == object_material("Chair_1", "Chair", (0.5, 0.5, 1.0))
    looks = {object_material(f"Chair_{i}", "Chair", (0.5, 0.5, 1.0)).model_dump_json() for i in range(12)}
    assert len(looks) > 3


# ---- bad input


def broken(where: str, value: Any) -> dict[str, Any]:
    house = copy.deepcopy(small_house())
    *path, last = [int(part) if part.isdigit() else part for part in where.split(".")]
    target: Any = house
    for part in path:
        target = target[part]
    if value is ...:
        del target[last]
    else:
        target[last] = value
    return house


@pytest.mark.parametrize(
    ("where", "value", "field", "expected"),
    [
        ("rooms.0.floorPolygon", ..., "rooms[0].floorPolygon", "present"),
        ("rooms.0.floorPolygon.1.x", math.nan, "rooms[0].floorPolygon[1].x", "finite"),
        (
            "rooms.0.floorPolygon",
            [vec(0, 0, 0), vec(4, 0, 3), vec(4, 0, 0), vec(0, 0, 3)],
            "rooms[0].polygon",
            "simple",
        ),
        ("rooms.1.id", "room|1", "walls[4].roomId", "a room's id"),
        ("walls", ..., "walls", "present"),
        ("walls.0.polygon", [], "walls[0].polygon", "at least 4"),
        ("walls.3.roomId", "room|9", "walls[3].roomId", "'room|9'"),
        ("doors.0.wall0", "wall|9", "doors[0].wall0", "'wall|9'"),
        ("doors.0.wall1", "wall|2|b", "doors[0].wall1", "other face"),
        ("doors.0.room1", "room|9", "doors[0].room1", "'room|9'"),
        ("doors.0.openness", 2, "doors[0].openness", "less than or equal to 1"),
        ("doors.0.holePolygon.1.x", 3.5, "doors[0].holePolygon", "within the wall's 3.000 m"),
        ("doors.0.holePolygon.1.x", 0.5, "doors[0].width", "greater than 0"),
        ("doors.0.holePolygon.1.y", 3.5, "doors[0].height", "within the wall's 3.000 m"),
        ("windows.0.holePolygon", [vec(0, 0, 0)], "windows[0].holePolygon", "at least 2"),
        ("objects.0.assetId", "Throne_1", "objects[0].assetId", "'Throne_1'"),
        ("objects.0.children.0.assetId", "Grail_1", "objects[0].children[0].assetId", "'Grail_1'"),
        ("objects.1.position", ..., "objects[1].position", "present"),
        ("objects.1.id", "", "objects[1].id", "at least 1 character"),
    ],
)
def test_an_error_names_the_field(where: str, value: Any, field: str, expected: str) -> None:
    with pytest.raises(InputError) as error:
        imported(broken(where, value))
    assert (error.value.source, error.value.field) == ("small.json", field)
    assert expected in error.value.expected


def test_files_and_the_missing_asset_database(tmp_path: Path) -> None:
    folder = tmp_path / "houses"
    folder.mkdir()
    path = folder / "small.json"
    path.write_text(json.dumps(small_house()))
    with pytest.raises(InputError, match=r"asset-database\.json"):
        load_scene(path)
    database = {"Any": [asset.model_dump() for asset in ASSETS.values()]}
    (tmp_path / "asset-database.json").write_text(json.dumps(database))
    assert load_scene(str(path)) == imported(small_house())
    (folder / "asset-database.json").write_text(json.dumps({"Any": [{"assetId": "Table_1"}]}))
    with pytest.raises(InputError, match=r"houses/asset-database.json: objectType"):
        load_scene(path)
    path.write_text(json.dumps(broken("rooms", ...)))
    (folder / "asset-database.json").unlink()
    with pytest.raises(InputError, match="rooms: expected this field to be present"):
        load_scene(path)


# ---- the real houses


@cache
def real() -> dict[str, tuple[dict[str, Any], Apartment]]:
    """Return every house of the ProcTHOR files: its JSON and its import."""
    database = DATA / "asset-database.json"
    assets = read_assets(json.loads(database.read_text()), database)
    houses = {path.stem: json.loads(path.read_text()) for path in sorted((DATA / "houses").glob("*.json"))}
    with gzip.open(DATA / "one_room_40.jsonl.gz", "rt") as lines:
        houses |= {f"one_room {i}": json.loads(line) for i, line in enumerate(lines)}
    return {name: (house, import_procthor(house, assets, name, name)) for name, house in houses.items()}


def side_points(wall: Wall, along: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return points 0.1 m off the wall's line, to its left and to its right."""
    c, s = math.cos(wall.yaw), math.sin(wall.yaw)
    x, y = wall.start[0] + c * along, wall.start[1] + s * along
    return (x - 0.1 * s, y + 0.1 * c), (x + 0.1 * s, y - 0.1 * c)


@needs_data
def test_every_real_house_is_imported_completely() -> None:
    assert len(real()) == 43

    def count(items: list[dict[str, Any]]) -> int:
        return sum(1 + count(item.get("children", [])) for item in items)

    for name, (house, flat) in real().items():
        assert len(flat.walls) * 2 == len(house["walls"]), name  # each wall has exactly two faces
        assert (len(flat.doors), len(flat.windows)) == (len(house["doors"]), len(house["windows"]))
        assert len(flat.furniture) == count(house["objects"])
        assert len(flat.content_hash()) == 16
    assert any("RoomsNotNavigable" in note for note in real()["house_0"][1].notes)


@needs_data
def test_real_doors_join_the_rooms_they_name() -> None:
    for name, (_, flat) in real().items():
        shapes = {room.name: shapely.Polygon(room.polygon) for room in flat.rooms}
        for door in flat.doors:
            points = side_points(flat.walls[door.wall], door.offset + door.width / 2)
            found = {next((n for n, s in shapes.items() if shapely.contains_xy(s, *p)), None) for p in points}
            assert found == set(door.rooms), name


@needs_data
def test_real_pictures_hang_on_the_walls_not_in_them() -> None:
    for name, (_, flat) in real().items():
        walls = shapely.union_all([footprint(b) for b in flat.boxes() if b.kind == "wall"])
        for piece in flat.furniture:
            if piece.category in ("Painting", "Television"):
                plan = footprint(piece.boxes[0])
                assert plan.intersection(walls).area < 0.1 * plan.area, (name, piece.name)


@needs_data
def test_holes_are_measured_from_the_first_corner_of_wall0() -> None:
    """The space in front of a hole is free of objects if its x runs from the first corner.

    If x ran from the second corner, it often would not be. The importer's docstring relies on this.
    """
    first, second, only_second, total = 0, 0, 0, 0
    for _, flat in real().values():
        boxes = [box for piece in flat.furniture for box in piece.boxes]
        for holes, reach in ((flat.doors, 0.3), (flat.windows, 0.12)):
            for hole in holes:
                wall = flat.walls[hole.wall]
                mirrored = wall.length - hole.offset - hole.width
                if abs(mirrored - hole.offset) < 0.1:
                    continue  # the same place either way
                clear = []
                for offset in (hole.offset, mirrored):
                    ends = [(offset + 0.03), (offset + hole.width - 0.03)]
                    line = shapely.LineString([np.mean(side_points(wall, at), axis=0) for at in ends])
                    zone = line.buffer(reach + (0.05 if reach < 0.2 else 0.0), cap_style="flat")
                    bottom, top = hole.sill + 0.05, hole.sill + hole.height - 0.03
                    clear.append(
                        not any(
                            box.center[2] - box.size[2] / 2 < top
                            and box.center[2] + box.size[2] / 2 > bottom
                            and footprint(box).intersection(zone).area > 1e-4
                            for box in boxes
                        )
                    )
                total += 1
                first, second = first + clear[0], second + clear[1]
                only_second += clear[1] and not clear[0]
    assert total == 99
    assert only_second == 0
    assert first >= 97 and second <= 50
