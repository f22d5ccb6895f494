"""Test apartments: geometric laws of the solid boxes, files, errors, the built-in scenes."""

import copy
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from vssm_gym.envs.scenes.scene import (
    ASSETS,
    Apartment,
    Door,
    Material,
    Room,
    SolidBox,
    Wall,
    Window,
    built_in_scenes,
    load_scene,
    save_scene,
)
from vssm_gym.errors import InputError

PAINT, PAPER = Material(texture="plaster"), Material(texture="wallpaper")


def inside(boxes: list[SolidBox], points: np.ndarray, slack: float = 0.0) -> np.ndarray:
    """Return ``(boxes, points)``, True where a point is inside a box that is grown by ``slack``."""
    rows = []
    for box in boxes:
        c, s = math.cos(box.yaw), math.sin(box.yaw)
        d = points - np.array(box.center)
        local = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=-1)
        rows.append((np.abs(local) <= np.array(box.size) / 2 + slack).all(axis=-1))
    return np.array(rows)


def footprint(box: SolidBox) -> shapely.Polygon:
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    half = [(i * box.size[0] / 2, j * box.size[1] / 2) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return shapely.Polygon([(box.center[0] + c * x - s * y, box.center[1] + s * x + c * y) for x, y in half])


def one_wall(length: float = 4.0, yaw: float = 0.0, doors=(), windows=(), two_sided: bool = False, **wall) -> Apartment:
    """Return a room of 30 x 30 m with a single free-standing wall from (1, 2)."""
    end = (1 + length * math.cos(yaw), 2 + length * math.sin(yaw))
    shape = {"thickness": 0.1, "height": 2.5, "front": PAINT, "back": PAPER if two_sided else PAINT} | wall
    return Apartment(
        name="wall",
        rooms=(Room(name="hall", kind="hall", polygon=[(-15, -15), (15, -15), (15, 15), (-15, 15)], floor=PAINT),),
        walls=(Wall(start=(1, 2), end=end, **shape),),
        doors=doors,
        windows=windows,
        ceiling_height=2.5,
    )


@st.composite
def walls_with_holes(draw):
    """Generate a wall and two disjoint holes in it, the first a door, the second a window."""
    length = draw(st.floats(2.0, 8.0))
    cuts = sorted(draw(st.lists(st.floats(0, length), min_size=4, max_size=4)))
    if cuts[1] - cuts[0] < 0.05 or cuts[3] - cuts[2] < 0.05:
        cuts = [0.1, 0.9, 1.0, length]
    door = Door(
        wall=0,
        offset=cuts[0],
        width=cuts[1] - cuts[0],
        height=draw(st.floats(0.5, 2.5)),
        leaves=0,
        rooms=("hall", None),
    )
    sill = draw(st.floats(0, 2))
    window = Window(wall=0, offset=cuts[2], width=cuts[3] - cuts[2], sill=sill, height=draw(st.floats(0.1, 2.5 - sill)))
    return one_wall(length, draw(st.floats(-4, 4)), (door,), (window,), draw(st.booleans()))


@given(walls_with_holes(), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_a_point_of_the_wall_is_solid_exactly_where_there_is_no_hole(apartment: Apartment, seed: int) -> None:
    wall, (door,), (window,) = apartment.walls[0], apartment.doors, apartment.windows
    boxes = [box for box in apartment.boxes() if box.kind == "wall"]
    solid_volume = sum(np.prod(box.size) for box in boxes)
    expected = wall.length * wall.height - door.width * door.height - window.width * window.height
    # slivers below a micrometre are left out
    assert solid_volume == pytest.approx(expected * wall.thickness, abs=1e-6)

    along, across, z = np.random.default_rng(seed).uniform([0, -0.05, 0], [wall.length, 0.05, 2.5], (200, 3)).T
    c, s = math.cos(wall.yaw), math.sin(wall.yaw)
    points = np.stack([1 + c * along - s * across, 2 + s * along + c * across, z], axis=-1)
    in_door = (along > door.offset) & (along < door.offset + door.width) & (z < door.height)
    in_window = (along > window.offset) & (along < window.offset + window.width)
    in_window &= (z > window.sill) & (z < window.sill + window.height)
    assert (inside(boxes, points, 1e-6).any(axis=0) == ~(in_door | in_window)).all()


def test_each_side_of_a_wall_has_its_own_material() -> None:
    layers = [box for box in one_wall(yaw=math.pi / 2, two_sided=True).boxes() if box.kind == "wall"]
    # start -> end is +y, so the front is towards -x
    assert [(box.material, box.center[0]) for box in layers] == [
        (PAINT, pytest.approx(1 - 0.025)),
        (PAPER, pytest.approx(1 + 0.025)),
    ]
    assert all(box.size == pytest.approx((4.0, 0.05, 2.5)) for box in layers)


@pytest.mark.parametrize("hinge", ["start", "end"])
@pytest.mark.parametrize("swing", ["front", "back"])
@pytest.mark.parametrize("leaves", [1, 2])
@given(openness=st.floats(0, 1), yaw=st.floats(-3, 3))
@settings(max_examples=15, deadline=None)
def test_leaves_turn_about_their_hinges(hinge: str, swing: str, leaves: int, openness: float, yaw: float) -> None:
    door = Door(
        wall=0,
        offset=1.2,
        width=0.9,
        height=2.0,
        openness=openness,
        leaves=leaves,
        hinge=hinge,
        swing=swing,
        rooms=("hall", None),
    )
    apartment = one_wall(yaw=yaw, doors=(door,))
    boxes = [box for box in apartment.boxes() if box.kind == "door"]
    assert len(boxes) == leaves
    c, s = math.cos(yaw), math.sin(yaw)
    side = 1 if swing == "front" else -1
    for box, end in zip(boxes, [hinge] if leaves == 1 else ["start", "end"], strict=True):
        assert box.size == pytest.approx((0.9 / leaves, 0.04, 2.0))
        assert abs(math.sin(box.yaw - yaw)) == pytest.approx(math.sin(openness * math.pi / 2), abs=1e-9)
        along = 1.2 if end == "start" else 2.1
        pivot = np.array([[1 + c * along - s * side * 0.05, 2 + s * along + c * side * 0.05, 1.0]])
        assert inside([box], pivot, 1e-9).all()  # the hinge lies on the leaf, on the wall's face
        # and the leaf never leaves the hole towards the other side
        dx, dy = box.center[0] - 1, box.center[1] - 2
        assert side * (c * dy - s * dx) >= 0.05 - 0.02 - 1e-9


def test_a_closed_door_fills_its_hole_and_an_open_one_frees_it() -> None:
    grid = np.stack(np.meshgrid(np.linspace(2.21, 3.09, 12), [2.0], np.linspace(0.01, 1.99, 12)), axis=-1).reshape(
        -1, 3
    )
    for openness, blocked in ((0.0, True), (1.0, False)):
        door = Door(wall=0, offset=1.2, width=0.9, height=2.0, openness=openness, rooms=("hall", None))
        boxes = [box for box in one_wall(doors=(door,)).boxes() if box.kind in ("wall", "door")]
        through = np.concatenate([grid + np.array([0, y, 0]) for y in np.linspace(-0.049, 0.049, 21)])
        hit = inside(boxes, through).any(axis=0).reshape(21, -1).any(axis=0)
        assert hit.all() if blocked else not hit.any()
    doorway = one_wall(doors=(Door(wall=0, offset=1.2, width=0.9, height=2.0, leaves=0, rooms=("hall", None)),))
    assert not [box for box in doorway.boxes() if box.kind == "door"]


def test_a_pane_fills_its_window() -> None:
    window = Window(wall=0, offset=1.0, width=1.5, height=1.2, sill=0.9)
    (pane,) = [box for box in one_wall(windows=(window,)).boxes() if box.kind == "window"]
    assert pane.center == pytest.approx((1 + 1.75, 2.0, 1.5))
    assert pane.size == pytest.approx((1.5, 0.02, 1.2))


@pytest.mark.parametrize("corner", ["L", "T"])
def test_walls_close_their_corners_without_coinciding_faces(corner: str) -> None:
    room = Room(name="r", kind="r", polygon=[(0, 0), (4, 0), (4, 3), (0, 3)], floor=PAINT)
    ends = [((0, 0), (4, 0)), ((4, 0), (4, 3))] if corner == "L" else [((0, 0), (4, 0)), ((2, 0), (2, 3))]
    walls = [
        Wall(start=a, end=b, thickness=t, height=2, front=PAINT, back=PAINT)
        for (a, b), t in zip(ends, (0.1, 0.2), strict=True)
    ]
    boxes = [
        box for box in Apartment(name="c", rooms=(room,), walls=walls, ceiling_height=2).boxes() if box.kind == "wall"
    ]
    if corner == "L":  # the outer corner of the angle is solid, up to the millimetre that keeps faces apart
        assert inside(boxes, np.array([[4 + 0.09, -0.04, 1.0]])).any()
        assert not inside(boxes, np.array([[4 + 0.11, -0.04, 1.0], [4 - 0.11, 0.06, 1.0]])).any()
    else:  # the second wall ends inside the first one
        assert footprint(boxes[1]).bounds[1] == pytest.approx(-0.049)
        assert footprint(boxes[0]).bounds == pytest.approx((0, -0.05, 4, 0.05))


def test_a_wall_that_continues_straight_on_does_not_overlap_the_next() -> None:
    room = Room(name="r", kind="r", polygon=[(0, 0), (4, 0), (4, 3), (0, 3)], floor=PAINT)
    ends = [((0, 0), (2, 0)), ((2, 0), (4, 0)), ((2, 0), (2, 3))]
    walls = [Wall(start=a, end=b, thickness=0.1, height=2, front=PAINT, back=PAINT) for a, b in ends]
    apartment = Apartment(name="c", rooms=(room,), walls=walls, ceiling_height=2)
    first, second, across = (footprint(box) for box in apartment.boxes() if box.kind == "wall")
    assert first.intersection(second).area == 0  # faces of different colours would flicker there
    assert across.bounds[1] == pytest.approx(-0.049)


@st.composite
def floor_plans(draw):
    """Generate two rooms: an L (rectilinear) and a triangle or a rectangle beside it."""
    w, d, a, b = (draw(st.floats(1.0, 5.0)) for _ in range(4))
    ell = [(0, 0), (w + a, 0), (w + a, d), (w, d), (w, d + b), (0, d + b)]
    beside = [(-a, 0), (0, 0), (0, d)] + ([(-a, d)] if draw(st.booleans()) else [])
    rooms = [
        Room(name="ell", kind="hall", polygon=ell[:: draw(st.sampled_from([1, -1]))], floor=PAINT),
        Room(name="beside", kind="hall", polygon=beside, floor=PAPER),
    ]
    wall = Wall(start=(0, 0), end=(1, 0), thickness=0.1, height=2, front=PAINT, back=PAINT)
    return Apartment(name="plan", rooms=rooms, walls=(wall,), ceiling_height=2)


@given(floor_plans(), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_floors_tile_the_apartment_and_follow_the_rooms(apartment: Apartment, seed: int) -> None:
    slabs = [box for box in apartment.boxes() if box.kind == "floor"]
    plans = [footprint(box) for box in slabs]
    whole = shapely.union_all(plans)
    assert sum(plan.area for plan in plans) == pytest.approx(whole.area)  # no overlap
    assert whole.area == pytest.approx(whole.envelope.area)  # no gap
    assert all(box.center[2] + box.size[2] / 2 == pytest.approx(0.0, abs=1e-12) for box in slabs)

    points = np.random.default_rng(seed).uniform(*np.array(whole.bounds).reshape(2, 2), (300, 2))
    owner = inside(slabs, np.column_stack([points, np.full(300, -0.05)])).argmax(axis=0)
    for room in apartment.rooms:
        shape = shapely.Polygon(room.polygon)
        # a slanted border follows a grid of 0.25 m
        deep = shapely.contains_xy(shape.buffer(-0.36 if room.name == "beside" else -1e-6), *points.T)
        assert all(slabs[owner[k]].name == room.name for k in np.flatnonzero(deep))


# ---- files


@pytest.fixture
def plain() -> dict:
    return json.loads((ASSETS / "oak.json").read_text())


def test_round_trip_keeps_everything(tmp_path: Path) -> None:
    oak = load_scene("oak")
    save_scene(oak, tmp_path / "copy.json")
    again = load_scene(tmp_path / "copy.json")
    assert again == oak and again.content_hash() == oak.content_hash()
    save_scene(again, tmp_path / "twice.json")
    assert (tmp_path / "twice.json").read_bytes() == (tmp_path / "copy.json").read_bytes()
    assert load_scene(oak) is oak


def test_the_hash_is_of_the_content(tmp_path: Path, plain: dict) -> None:
    oak = load_scene("oak")
    shuffled = dict(reversed(plain.items())) | {"notes": ["a remark"]}
    (tmp_path / "a.json").write_text(json.dumps(shuffled))
    assert load_scene(tmp_path / "a.json").content_hash() == oak.content_hash()
    moved = oak.walls[0].model_copy(update={"height": oak.walls[0].height + 1e-9})
    assert oak.model_copy(update={"walls": (moved, *oak.walls[1:])}).content_hash() != oak.content_hash()
    assert len(oak.content_hash()) == 16


def test_a_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.json"
    path.write_text("old")
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save_scene(load_scene("oak"), path)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["scene.json"]


def change(data: dict, where: str, value: object) -> dict:
    """Return a copy of data with the field at "a.0.b" set, or removed where value is `...`."""
    data = copy.deepcopy(data)
    *path, last = [int(part) if part.isdigit() else part for part in where.split(".")]
    target = data
    for part in path:
        target = target[part]
    if value is ...:
        del target[last]
    else:
        target[last] = value
    return data


@pytest.mark.parametrize(
    ("where", "value", "field", "expected"),
    [
        ("walls.0.thickness", -1, "walls[0].thickness", "greater than 0"),
        ("walls.0.height", 0, "walls[0].height", "greater than 0"),
        ("walls.3.end", ..., "walls[3].end", "present"),
        ("walls.3.colour", "red", "walls[3].colour", "no such field"),
        ("walls.0.front.texture", "velvet", "walls[0].front.texture", "one of"),
        ("walls.0.front.color", [1, 2, 0], "walls[0].front.color[1]", "less than or equal to 1"),
        ("walls.2.end", [10.0, 0.0], "walls[2].end", "1 mm away"),
        ("rooms.1.polygon", [[0, 0], [1, 1], [1, 0], [0, 1]], "rooms[1].polygon", "simple polygon"),
        ("rooms.1.polygon", [[0, 0], [1, 1]], "rooms[1].polygon", "at least 3"),
        ("rooms.1.name", "bedroom", "rooms[2].name", "unique"),
        ("rooms", [], "rooms", "at least 1"),
        ("doors.0.offset", 3.5, "doors[0].offset", "within the wall's 3.900 m"),
        ("doors.0.height", 2.7, "doors[0].height", "within the wall's 2.600 m"),
        ("doors.0.wall", 99, "doors[0].wall", "index below 17"),
        ("doors.0.rooms", ["attic", None], "doors[0].rooms[0]", "a room's name"),
        ("doors.0.openness", 1.5, "doors[0].openness", "less than or equal to 1"),
        ("doors.0.leaves", 3, "doors[0].leaves", "0, 1 or 2"),
        ("windows.0.sill", 1.5, "windows[0].height", "within"),
        ("windows.1.offset", 1.5, "windows[1].offset", "does not overlap windows[0]"),
        ("furniture.0.boxes", [], "furniture[0].boxes", "at least 1"),
        ("furniture.1.boxes.0.size", [1, 0, 1], "furniture[1].boxes[0].size[1]", "greater than 0"),
        ("furniture.1.boxes.0.center", "here", "furniture[1].boxes[0].center", "tuple"),
        ("format", 2, "format", "1"),
        ("ceiling_height", None, "ceiling_height", "number"),
    ],
)
def test_an_error_names_the_file_the_field_and_the_expected_value(
    tmp_path: Path, plain: dict, where: str, value: object, field: str, expected: str
) -> None:
    path = tmp_path / "flat.json"
    path.write_text(json.dumps(change(plain, where, value)))
    with pytest.raises(InputError) as error:
        load_scene(path)
    assert error.value.source == str(path) and error.value.field == field
    assert expected in error.value.expected
    assert "\n" not in str(error.value) and len(str(error.value)) < 900


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b'{"rooms": [', "valid JSON"),
        (b"[1, 2]", "a JSON object"),
        (b"\xff\xfe\x00", "UTF-8"),
        (b"[" * 100_000, "nested at most"),
        (b'{"ceiling_height": NaN}', "finite numbers"),
        (b'{"ceiling_height": 1e999, "name": "x", "rooms": []}', "finite|present|at least"),
    ],
)
def test_a_file_that_is_not_a_scene(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "broken.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=expected):
        load_scene(path)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"baobab: scene: .*oak.*procedural:SEED"):
        load_scene("baobab")


def test_numbers_are_finite_in_python_too() -> None:
    with pytest.raises(ValidationError, match="finite"):
        Wall(start=(0, 0), end=(math.nan, 1), thickness=0.1, height=2, front=PAINT, back=PAINT)


# ---- built-in scenes


@pytest.mark.parametrize("name", built_in_scenes())
def test_built_in_scenes_are_sound(name: str) -> None:
    apartment = load_scene(name)
    assert apartment.name == name
    assert (ASSETS / f"{name}.json").stat().st_size < 150_000
    assert name in (ASSETS / "LICENSES.md").read_text()
    plan = shapely.union_all([shapely.Polygon(room.polygon) for room in apartment.rooms])
    walls = shapely.union_all([footprint(box) for box in apartment.boxes() if box.kind == "wall"])
    for piece in apartment.furniture:
        for box in piece.boxes:
            assert (
                box.center[2] - box.size[2] / 2 >= -1e-6
                and box.center[2] + box.size[2] / 2 <= apartment.ceiling_height + 1e-6
            )
            ground = footprint(box)
            assert plan.contains(ground), piece.name
            assert ground.intersection(walls).area < 1e-6, f"{piece.name} stands in a wall"
    assert all(door.width >= 0.85 for door in apartment.doors)


def test_oak_has_five_rooms_and_passages_of_clear_width() -> None:
    oak = load_scene("oak")
    assert len(oak.rooms) == 5 and oak.ceiling_height == 2.6
    low = [
        b
        for b in oak.boxes()
        if b.kind not in ("floor", "ceiling")
        and b.center[2] - b.size[2] / 2 < 0.5
        and b.center[2] + b.size[2] / 2 > 0.01
    ]
    floor = shapely.union_all([shapely.Polygon(room.polygon) for room in oak.rooms])
    free = floor.difference(shapely.union_all([footprint(box) for box in low]))
    for radius in (0.07, 0.1, 0.15, 0.22):  # one region for every robot up to 0.44 m wide, and it meets every room
        centres = free.buffer(-radius)
        parts = [part for part in getattr(centres, "geoms", [centres]) if part.area > 0.01]
        assert len(parts) == 1
        assert all(parts[0].intersection(shapely.Polygon(room.polygon)).area > 1.0 for room in oak.rooms)
    # What a 0.13 m disc covers and a 0.44 m disc does not are rounded corners, never a corridor.
    between = free.buffer(-0.065).buffer(0.065).difference(free.buffer(-0.22).buffer(0.225))
    assert max(part.area for part in between.geoms) < 0.025
