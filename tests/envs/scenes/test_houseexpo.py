"""Test HouseExpo plans: free space is the polygon, doors stand at narrow passages, and damaged files are refused."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from tests.helpers.damage import damaged_json, valid_or_refused
from tests.helpers.paths import SHARED_DATA
from tests.helpers.scene_checks import check_scene
from vssm_gym.envs.scenes.importers.houseexpo import import_houseexpo
from vssm_gym.envs.scenes.importers.plan_rooms import split_rooms
from vssm_gym.envs.scenes.importers.plan_walls import square_corners
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.errors import InputError

DATA = SHARED_DATA / "houseexpo"
PLANS = sorted(DATA.glob("*.json"))
needs_data = pytest.mark.skipif(not PLANS, reason="the houseexpo files are not on this machine")

# Two rooms of 4 x 3 m and 3 x 3 m; the wall between them, x 4 to 4.1, has a gap at y 1 to 1.9.
VERTS = [[0, 0], [4, 0], [4, 1], [4.1, 1], [4.1, 0], [7.1, 0], [7.1, 3], [4.1, 3], [4.1, 1.9], [4, 1.9], [4, 3], [0, 3]]
PLAN: dict[str, Any] = {
    "verts": VERTS,
    "id": "two",
    "room_num": 2,
    "bbox": {"min": [0, 0], "max": [7.1, 3]},
    "room_category": {"Bedroom": [[-0.1, -0.1, 4.1, 3.1]], "Living_Room": [[4, -0.1, 7.2, 3.1]]},
}


def obstacles(flat: Apartment) -> shapely.Geometry:
    """Return the solid area below 0.5 m."""
    low = [b for b in flat.boxes() if b.center[2] - b.size[2] / 2 < 0.5 and b.center[2] + b.size[2] / 2 > 0.01]
    return shapely.union_all([footprint(box) for box in low])


def test_two_rooms_by_hand() -> None:
    flat = import_houseexpo(PLAN, "two", "two.json")
    assert [(room.name, room.kind) for room in flat.rooms] == [
        ("Bedroom", "bedroom"),
        ("Living room", "living room"),
    ] or [room.name for room in flat.rooms] == ["Living room", "Bedroom"]
    (door,) = flat.doors
    wall = flat.walls[door.wall]
    assert (door.width, door.leaves, door.offset) == (pytest.approx(0.9), 0, 0.0)
    assert {round(wall.start[0], 3), round(wall.end[0], 3)} == {4.05}  # in the middle of the wall it goes through
    assert wall.thickness == pytest.approx(0.1)
    assert set(door.rooms) == {"Bedroom", "Living room"}
    areas = sorted(Polygon(room.polygon).area for room in flat.rooms)
    assert areas == pytest.approx([9 + 0.45 * 0.1, 12 + 0.45 * 0.1], abs=1e-9)
    lintel = [b for b in flat.boxes() if b.name == f"wall {door.wall}"]
    assert [(round(b.center[2] - b.size[2] / 2, 3)) for b in lintel] == [2.05]
    assert any(piece.category == "picture" for piece in flat.furniture)


def _ell(x: float, y: float, width: float, angle: float) -> list[list[float]]:
    points = np.array([(0, 0), (x, 0), (x, width), (width, width), (width, y), (0, y)])
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return (points @ turn).tolist()


@st.composite
def outlines(draw: st.DrawFn) -> list[list[float]]:
    """Generate simple polygons: stars around a centre, rotated L-shapes, and the rotated two rooms."""
    kind = draw(st.sampled_from(["star", "ell", "rooms"]))
    angle = draw(st.floats(-math.pi, math.pi))
    if kind == "ell":
        return _ell(draw(st.floats(3, 9)), draw(st.floats(3, 9)), draw(st.floats(1.2, 2.5)), angle)
    if kind == "rooms":
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        return (np.array(VERTS) @ turn + 5.0).tolist()
    n = draw(st.integers(3, 14))
    radii = np.array(draw(st.lists(st.floats(1.5, 8), min_size=n, max_size=n)))
    angles = angle + 2 * math.pi * np.arange(n) / n
    return np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1).tolist()


@given(outlines())
@settings(max_examples=60, deadline=None)
def test_free_space_is_the_outline(verts: list[list[float]]) -> None:
    """Rooms tile the outline; walls lie outside of it (up to 1 cm inside at very sharp corners) and leave no gap."""
    outline = square_corners(shapely.orient_polygons(Polygon(verts)))
    flat = import_houseexpo({"verts": verts}, "plan", "plan.json")
    rooms = [Polygon(room.polygon) for room in flat.rooms]
    assert shapely.union_all(rooms).symmetric_difference(outline).area < 1e-6 * outline.area + 1e-6
    assert sum(room.area for room in rooms) == pytest.approx(outline.area, abs=1e-5)
    solid = obstacles(flat)
    assert outline.buffer(-0.011).intersection(solid).area < 1e-6
    # Whoever walks straight out of the outline meets a wall.
    edge = outline.exterior
    points = np.array([edge.interpolate(d).coords[0] for d in np.linspace(0, edge.length, 97)[:-1]])
    ahead = np.array([edge.interpolate(d + 1e-4).coords[0] for d in np.linspace(0, edge.length, 97)[:-1]]) - points
    out = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    assert shapely.distance(solid, shapely.points(points + 0.005 * out)).max() < 1e-3


@pytest.mark.parametrize(
    ("width", "doors"), [(0.2, 0), (0.7, 1), (1.2, 1), (2.0, 1), (2.6, 0)], ids=lambda value: str(value)
)
def test_doors_are_where_the_plan_is_narrow(width: float, doors: int) -> None:
    low = (3 - width) / 2
    gap = {1: low, 1.9: low + width}
    outline = Polygon([[x, gap.get(y, y)] for x, y in VERTS])
    rooms, openings = split_rooms(outline)
    assert (len(openings), len(rooms)) == (doors, doors + 1)
    assert all(opening.width == pytest.approx(width) for opening in openings)


def test_a_corridor_is_not_divided() -> None:
    """No place is wider than the corridor itself, so that its bends are not doors."""
    bend = [[0, 0], [8, 0], [8, 5], [7, 5], [7, 1], [0, 1]]
    assert len(split_rooms(Polygon(bend))[0]) == 1


def star(points: int) -> list[list[float]]:
    """Return the corners of a star between circles of 5 and 20 m."""
    angle = np.linspace(0.0, 2.0 * np.pi, 2 * points, endpoint=False)
    radius = np.where(np.arange(2 * points) % 2, 20.0, 5.0)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).tolist()


@pytest.mark.parametrize(
    ("change", "field", "expected"),
    [
        ({"verts": [[0, 0], [4, 0]]}, "verts", "at least 3"),
        ({"verts": [[0, 0], [4, 0], [math.nan, 3]]}, "verts[2][0]", "finite"),
        ({"verts": [[0, 0], [4, 0], [1e9, 3]]}, "verts[2][0]", "less than or equal"),
        ({"verts": [[0, 0], [400, 0], [0, 3]]}, "verts", "at most 100 m"),
        ({"verts": [[0, 0], [4, 3], [4, 0], [0, 3]]}, "verts", "Self-intersection"),
        ({"verts": [[0, 0], [4, 0], [8, 0]]}, "verts", "simple polygon"),
        ({"verts": [[0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5]]}, "verts", "at least 1 m^2"),
        ({"verts": [[0, 0]] * 1001}, "verts", "at most 1000"),
        ({"verts": star(100)}, "verts", "at most 1,000 pieces of walls"),
        ({"room_category": {"Bedroom": [[0, 0, 1, 1]] * 301}}, "room_category", "at most 300 boxes"),
        ({"room_category": {"Bedroom": [[0, 0, 1]]}}, "room_category", "at least 4"),
        ({"room_category": []}, "room_category", "dictionary"),
    ],
)
def test_bad_plans_are_refused(change: dict[str, Any], field: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        import_houseexpo(PLAN | change, "bad", "bad.json")
    assert caught.value.source == "bad.json"
    assert field in caught.value.field
    assert expected in caught.value.expected


def test_an_outline_that_touches_itself_is_repaired() -> None:
    verts = [[0, 0], [4, 0], [4, 3], [4.3, 3.3], [4, 3], [0, 3]]  # a spike without area
    flat = import_houseexpo({"verts": verts}, "spike", "spike.json")
    assert sum(Polygon(room.polygon).area for room in flat.rooms) == pytest.approx(12.0)
    assert any("repaired" in note for note in flat.notes)


@given(damaged_json(PLAN))
@settings(max_examples=150, deadline=None)
def test_damaged_plans(data: Any) -> None:
    valid_or_refused(lambda: import_houseexpo(data, "damaged", "damaged.json"))


@needs_data
@pytest.mark.parametrize("path", PLANS, ids=lambda path: path.stem[:8])
def test_real_plans(path: Path) -> None:
    flat = load_scene(path)
    space = check_scene(flat)
    assert space.cut_off_rooms() == []
    outline = Polygon(json.loads(path.read_text())["verts"])
    exact = outline.buffer(-0.1, quad_segs=32)  # the positions of a disc of 0.1 m in the file's polygon
    assert space.region.symmetric_difference(exact).area < 0.012 * exact.area
    assert load_scene(path).content_hash() == flat.content_hash()
