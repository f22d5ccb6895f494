"""Test furnished plans: rooms get furniture of their kind; doors and passages stay as clear as in generated homes.

The geometry is checked from the solid boxes alone, with shapely and not with the generator's own arithmetic.
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from shapely import Polygon

from tests.envs.scenes.test_houseexpo import PLAN, VERTS, outlines
from tests.helpers.scene_checks import check_scene
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Room
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.generator import furnish_plan
from vssm_gym.envs.scenes.generator.furnish_plan import furnished_as
from vssm_gym.envs.scenes.generator.plan_ground import plan_ground
from vssm_gym.envs.scenes.importers.houseexpo import import_houseexpo
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.envs.scenes.solids import SolidBox, footprint
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.errors import InputError

# What a room of a kind has at any seed, one of each group.
NEEDED = {
    "kitchen": [{"counter", "stove", "fridge"}],
    "bathroom": [{"toilet"}, {"vanity"}],
    "toilet": [{"toilet"}, {"vanity"}],
    "bedroom": [{"bed"}],
    "living room": [{"sofa"}],
    "storage": [{"storage shelf"}],
}
SHARED = (
    "0004d52d1aeeb8ae6de39d6bd993e992",
    "000514ade3bcc292a613a4c2755a5050",
    "0016652bf7b3ec278d54e0ef94476eb8",
    "0099c392987b98355e984f7d06837dbc",
    "011bef0381ddca9381a7aeb1d0b0777d",
    "1f99717550c31ae321ca2313edceedcc",
)


def plan(verts: list[Any], categories: dict[str, Any] | None = None) -> Apartment:
    return import_houseexpo({"verts": verts, "room_category": categories or {}}, "plan", "plan.json")


def jagged() -> Apartment:
    """Return the two rooms with bends of a centimetre in a wall, a wall askew and a corner cut off."""
    bend = [[5.0, 3.0], [4.99, 3.01], [4.1, 3.01]]
    verts = [[1.2, 0], *VERTS[1:6], [7.1, 2.5], [6.6, 3.0], *bend, *VERTS[8:11], [0, 3], [0, 0.9]]
    return plan(verts, PLAN["room_category"])


def tall(box: SolidBox) -> bool:
    """Return True for a box that stops a ground robot."""
    return box.center[2] - 0.5 * box.size[2] < 0.5 and box.center[2] + 0.5 * box.size[2] > 0.01


def free_floor(apartment: Apartment) -> shapely.Geometry:
    """Return the floor between everything that stops a ground robot."""
    floor = shapely.union_all([Polygon(room.polygon) for room in apartment.rooms])
    return floor - shapely.union_all([footprint(box) for box in apartment.boxes() if tall(box) and box.kind != "floor"])


def check_furnished(bare: Apartment, furnished: Apartment) -> None:
    """Check the laws of a furnished plan against the plan."""
    assert furnished.rooms == bare.rooms and furnished.walls == bare.walls and furnished.doors == bare.doors
    assert furnished.notes[: len(bare.notes)] == bare.notes
    boxes = furnished.boxes()
    fixed = [box for box in boxes if box.kind in ("wall", "door", "window")]
    solid = [box for box in boxes if box.kind == "furniture" and box.center[2] + 0.5 * box.size[2] > 0.01]
    rooms = {room.name: Polygon(room.polygon) for room in furnished.rooms}
    walls = shapely.union_all([footprint(box) for box in fixed if box.center[2] - 0.5 * box.size[2] < 1.0])
    for box in solid:  # in its own room, and in no wall
        home = max((room for room in rooms if box.name.startswith(room + " ")), key=len)
        assert rooms[home].buffer(1e-6).contains(footprint(box)), box.name
        assert footprint(box).intersection(walls).area < 1e-6, f"{box.name} is in a wall"
    for piece in furnished.furniture:  # on the floor, or on a wall, or under the ceiling
        mine = [box for box in boxes if box.name == piece.name]
        low = min(box.center[2] - 0.5 * box.size[2] for box in mine)
        high = max(box.center[2] + 0.5 * box.size[2] for box in mine)
        at_wall = min(footprint(box).distance(walls) for box in mine) < 0.08
        assert low < 1e-3 or at_wall or high > furnished.ceiling_height - 0.03, f"{piece.name} floats"
    tree = shapely.STRtree([footprint(box) for box in solid])
    for box in solid:  # no two pieces share space
        for j in tree.query(footprint(box)):
            other = solid[j]
            apart = abs(box.center[2] - other.center[2]) > 0.5 * (box.size[2] + other.size[2]) - 1e-5
            assert box.name == other.name or apart or footprint(box).intersection(footprint(other)).area < 1e-6
    for radius in (0.1, 0.15, 0.2):  # every robot reaches the rooms that it reached before
        cut_off = [FreeSpace.from_apartment(one, radius, 0.5).cut_off_rooms() for one in (bare, furnished)]
        assert set(cut_off[1]) <= set(cut_off[0])
    for door in furnished.doors:  # nothing stands before a door
        wall = furnished.walls[door.wall]
        u = np.array([math.cos(wall.yaw), math.sin(wall.yaw)])
        line = shapely.LineString([wall.start + u * (door.offset + s * door.width) for s in (0.02, 0.98)])
        way = line.buffer(0.5 * wall.thickness + 0.55, cap_style="flat")
        assert not any(footprint(box).intersection(way).area > 1e-6 for box in solid if tall(box)), door.rooms
    # What a disc of 0.13 m covers and one of 0.44 m does not is a rounded corner, or as narrow in the bare plan.
    narrow = [
        one.buffer(-0.065).buffer(0.065).difference(one.buffer(-0.22).buffer(0.225))
        for one in (free_floor(bare), free_floor(furnished))
    ]
    for part in shapely.get_parts(narrow[1].difference(narrow[0].buffer(0.05))):
        assert part.area < 0.03, f"a narrow passage at {part.representative_point()}"


def check_kinds(furnished: Apartment) -> None:
    """Check that every room of a known kind has what its kind needs."""
    others = {room.name for room in furnished.rooms}
    for room in furnished.rooms:
        inner = {name for name in others if name.startswith(room.name + " ")}
        mine = {
            piece.category
            for piece in furnished.furniture
            if piece.name.startswith(room.name + " ") and not any(piece.name.startswith(name + " ") for name in inner)
        }
        for group in NEEDED.get(room.kind, []):
            assert mine & group, f"{room.name} has {sorted(mine)}"


@cache
def furnished_pair(which: str, seed: int) -> tuple[Apartment, Apartment]:
    bare = import_houseexpo(PLAN, "two", "two.json") if which == "two" else jagged()
    return bare, furnish_plan(bare, seed)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("which", ["two", "jagged"])
def test_laws_of_a_furnished_plan(which: str, seed: int) -> None:
    bare, furnished = furnished_pair(which, seed)
    check_furnished(bare, furnished)
    check_kinds(furnished)


def test_the_same_seed_gives_the_same_scene_and_its_file_is_the_same_too(tmp_path: Path) -> None:
    bare, furnished = furnished_pair("two", 0)
    assert furnish_plan(bare, 0) == furnished
    assert furnished_pair("two", 1)[1].content_hash() != furnished.content_hash()
    assert furnished.name == "two-furnished-0"
    save_scene(furnished, tmp_path / "home.json")
    again = load_scene(tmp_path / "home.json")
    assert again.content_hash() == furnished.content_hash() and again.notes == furnished.notes
    TaskSampler(again, HolonomicRobot()).draw(np.random.default_rng(0))


def test_the_ground_of_a_jagged_room_is_straight() -> None:
    """Bends of a centimetre are lost, along the part of a wall that stands furthest into the room."""
    bare = jagged()
    room = next(room for room in bare.rooms if room.kind == "living room")
    ground = plan_ground(bare, bare.boxes(), room)
    assert ground is not None
    outline = Polygon(ground.corners)
    whole = Polygon(room.polygon)
    assert whole.buffer(1e-3).contains(outline) and outline.area > 0.9 * whole.area
    assert (np.abs(np.diff(ground.corners, axis=0, append=ground.corners[:1])).min(axis=1) < 1e-9).all()
    assert ground.corners[:, 1].max() == pytest.approx(3.0)  # and not 3.01
    solids = shapely.union_all([shapely.box(*row[[0, 1, 3, 4]]) for row in ground.solids])
    assert solids.intersection(outline).area < 1e-9
    assert outline.buffer(0.05).difference(outline).difference(solids).area < 1e-6  # wall all around


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("living room", "living room"),
        ("toilet", "bathroom"),
        ("child room", "kids room"),
        ("guest room", "bedroom"),
        ("office", "study"),
        ("garage", "storage"),
        ("entryway", "hall"),
        ("Dining_Room", "dining room"),
    ],
)
def test_the_words_of_a_kind_decide(kind: str, expected: str) -> None:
    room = Room(name="room", kind=kind, polygon=((0, 0), (4, 0), (4, 3), (0, 3)))
    assert furnished_as(room, np.random.default_rng(0)) == (expected, True)


@pytest.mark.parametrize(("side", "kinds"), [(1.5, {"hall", "storage"}), (6.0, {"living room"})])
def test_the_area_decides_where_the_kind_is_unknown(side: float, kinds: set[str]) -> None:
    room = Room(name="room", kind="room", polygon=((0, 0), (side, 0), (side, side), (0, side)))
    drawn = [furnished_as(room, np.random.default_rng(seed)) for seed in range(20)]
    assert {kind for kind, _ in drawn} == kinds and not any(known for _, known in drawn)


def test_a_room_of_unknown_kind_or_without_a_place_gets_a_note() -> None:
    """The second room is a passage half a metre wide."""
    passage = [[4.1, 1.04], [4.1, 1], [7.6, 1], [7.6, 1.5], [4.1, 1.5], [4.1, 1.46]]
    bare = plan([[0, 0], [4, 0], [4, 1.04], *passage, [4, 1.46], [4, 3], [0, 3]])
    assert [room.name for room in bare.rooms] == ["Room", "Room 2"]
    furnished = furnish_plan(bare, 0)
    assert furnished.notes[len(bare.notes) :] == (
        "Room, whose kind the file does not give, is furnished as a kids room",
        "Room 2 stays without furniture",
    )
    check_furnished(bare, furnished)


@pytest.mark.parametrize(
    ("make", "seed", "message"),
    [
        (lambda: load_scene("oak"), 0, r"oak: furniture: expected a plan without furniture"),
        (lambda: plan(VERTS), -1, r"plan: seed: expected 0 to 2\^63 - 1"),
        (lambda: plan(VERTS), 1.5, r"plan: seed: expected a whole number"),
        (lambda: plan([[0, 0], [3, 0], [3, 0.4], [0, 0.4]]), 0, r"plan: rooms: expected a room with a place"),
    ],
)
def test_what_cannot_be_furnished_is_refused(make: Any, seed: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        furnish_plan(make(), seed)


@pytest.mark.slow
@given(outlines())
@settings(max_examples=40, deadline=None)
def test_outlines_of_any_form_are_furnished_or_refused(verts: list[list[float]]) -> None:
    bare = plan(verts)
    try:
        furnished = furnish_plan(bare, 3)
    except InputError as error:
        assert error.field == "rooms"
        return
    check_furnished(bare, furnished)


@pytest.mark.parametrize("name", SHARED)
def test_real_plans(name: str, shared_data: Path) -> None:
    bare = load_scene(shared_data / "houseexpo" / f"{name}.json")
    for seed in (0, 1):
        furnished = furnish_plan(bare, seed)
        check_furnished(bare, furnished)
        check_kinds(furnished)
    assert not any("stays without" in note for note in furnished.notes)
    check_scene(furnished, steps=10)
