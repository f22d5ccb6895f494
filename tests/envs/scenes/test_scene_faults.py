"""Test the warnings about scenes: missing walls and misplaced objects are each named once."""

import json
import warnings
from pathlib import Path
from typing import Any

import pytest

from tests.envs.scenes.test_procthor import imported, small_house, vec
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Box, Furniture, Material, Room, Wall
from vssm_gym.envs.scenes.faults import MOST_SENTENCES, floating, misplaced, open_edges, with_notes
from vssm_gym.envs.scenes.importers.houseexpo import import_houseexpo
from vssm_gym.envs.scenes.importers.mjcf import import_mjcf
from vssm_gym.envs.scenes.scene import built_in_scenes, load_scene, save_scene
from vssm_gym.envs.tasks.mazes import FOLDER, MAZES

CORNERS = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))
PLAIN = Material()


def box(x: float, y: float, z: float, size: tuple[float, float, float] = (0.6, 0.6, 0.6)) -> Box:
    return Box(center=(x, y, z), size=size, material=PLAIN)


def room(*furniture: tuple[str, Box], walls: int = 4, height: float = 2.5) -> Apartment:
    """Return a room of 4 x 3 m with the first of its walls, in the order y = 0, x = 4, y = 3, x = 0."""
    sides = zip(CORNERS, (*CORNERS[1:], CORNERS[0]), strict=True)
    made = [Wall(start=a, end=b, thickness=0.1, height=height, front=PLAIN, back=PLAIN) for a, b in sides]
    pieces = [Furniture(name=name, category="thing", boxes=(one,)) for name, one in furniture]
    return Apartment(
        name="room",
        rooms=(Room(name="Den", kind="room", polygon=CORNERS, floor=PLAIN),),
        walls=tuple(made[:walls]),
        furniture=tuple(pieces),
        ceiling_height=2.5,
    )


def test_a_missing_wall_is_named_with_its_place() -> None:
    assert open_edges(room()) == []
    # The walls beside it close their thickness and the rounding: 0.07 m at each end.
    assert open_edges(room(walls=3)) == ["Den has no wall along 2.86 m of its edge, from (0.00, 2.93) to (0.00, 0.07)"]
    assert len(open_edges(room(walls=1))) == 3
    assert len(open_edges(room(height=0.2))) == 4  # what one can step over closes nothing


def test_furniture_may_stand_for_a_wall() -> None:
    shelf = ("shelf", box(0.0, 1.5, 1.0, (0.3, 3.0, 2.0)))
    assert open_edges(room(shelf, walls=3)) == []


@pytest.mark.parametrize(
    ("at", "sentence"),
    [
        (box(2, 1, 0.3), None),
        (box(9, 1, 0.3), "thing is outside the walls"),
        (box(2, 1, -2.0), "thing is under the floor"),
        (box(2, 1, 5.0), "thing is above the ceiling"),
        (box(2, 1, 0.3, (1e-6, 1e-6, 1e-6)), "thing is smaller than 1 mm"),
    ],
)
def test_unreachable_objects_are_named(at: Box, sentence: str | None) -> None:
    assert misplaced(room(("thing", at))) == ([] if sentence is None else [sentence])


def test_large_floating_objects_are_named() -> None:
    table, lamp = ("table", box(2, 1, 0.35, (1.0, 1.0, 0.7))), ("lamp", box(2, 1, 2.2))
    assert floating(room(table, ("chest", box(2, 1, 1.0)), lamp)) == []  # on the table; from the ceiling
    assert floating(room(("board", box(0.36, 1.5, 1.5)))) == []  # at the wall
    assert floating(room(("chest", box(2, 1, 1.2)))) == ["chest hangs in the air, 0.90 m above the floor"]
    assert floating(room(("cup", box(2, 1, 1.2, (0.1, 0.1, 0.1))))) == []


def test_a_fault_adds_a_warning_and_a_note_and_leaves_the_scene_unchanged() -> None:
    odd = room(*((f"chair {i}", box(9, i, 0.3)) for i in range(MOST_SENTENCES + 5)), walls=3)
    with pytest.warns(UserWarning, match=r"room: Den has no wall along .*; chair 0 is outside the walls") as caught:
        said = with_notes(odd, open_edges, misplaced)
    assert len(caught) == 1
    assert len(said.notes) == 1 + MOST_SENTENCES + 1 and said.notes[-1] == "and 5 more of the same kind"
    assert said.content_hash() == odd.content_hash()
    with pytest.warns(UserWarning, match="Den has no wall"):
        assert with_notes(said, open_edges, misplaced) == said  # notes that a file has are not doubled
    assert with_notes(room(), open_edges, misplaced, floating) == room()


def test_scene_files_are_checked(tmp_path: Path) -> None:
    save_scene(room(("chair", box(9, 1, 0.3)), ("bed", box(2, 1, 1.3)), walls=3), tmp_path / "mine.json")
    with pytest.warns(UserWarning, match="no wall along.*chair is outside the walls.*bed hangs in the air"):
        scene = load_scene(tmp_path / "mine.json")
    assert len(scene.notes) == 3


def test_a_removed_wall_of_a_built_in_scene_is_reported(tmp_path: Path) -> None:
    oak = load_scene("oak")
    holes = {door.wall for door in oak.doors} | {window.wall for window in oak.windows}
    for number in [i for i in range(len(oak.walls)) if i > max(holes)] or [len(oak.walls) - 1]:
        walls = [wall for i, wall in enumerate(oak.walls) if i != number]
        less = oak.model_copy(update={"walls": tuple(walls), "doors": (), "windows": ()})
        assert open_edges(less), number


def test_built_in_scenes_have_no_faults() -> None:
    scenes: list[Any] = [*built_in_scenes(), *(FOLDER / f"{maze}.json" for maze in MAZES), "procedural:3"]
    for scene in scenes:
        apartment = load_scene(scene)
        assert open_edges(apartment) + misplaced(apartment) + floating(apartment) == [], scene


def test_houses_report_objects_outside_and_missing_walls() -> None:
    house = small_house()
    house["objects"][0]["position"] = vec(20, 0.4, 1)
    with pytest.warns(UserWarning, match="table is outside the walls"):
        imported(house)
    house = small_house()
    used = {hole[side] for hole in (*house["doors"], *house["windows"]) for side in ("wall0", "wall1")}
    exterior = next(wall for wall in house["walls"] if wall["id"] not in used and "exterior" not in wall["id"])
    house["walls"] = [wall for wall in house["walls"] if wall is not exterior]
    same = {(p["x"], p["z"]) for p in exterior["polygon"]}
    house["walls"] = [wall for wall in house["walls"] if {(p["x"], p["z"]) for p in wall["polygon"]} != same]
    with pytest.warns(UserWarning, match="has no wall along"):
        assert any("has no wall along" in note for note in imported(house).notes)


def test_models_report_objects_outside_and_below_the_floor(tmp_path: Path) -> None:
    geoms = (
        '<geom type="plane" name="floor" size="3 3 .1"/><geom type="box" name="far" size=".2 .2 .2" pos="9 0 .2"/>'
        '<geom type="box" name="deep" size=".2 .2 .2" pos="0 0 -1"/><geom type="box" size=".2 .2 .2" pos="1 1 .2"/>'
    )
    path = tmp_path / "room.xml"
    path.write_text(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    with pytest.warns(UserWarning, match="room: far is outside the walls"):
        notes = import_mjcf(path).notes
    assert any("1 geom under the floor" in note for note in notes)


def test_plans_report_categories_outside_of_them() -> None:
    plan = {
        "verts": [[0, 0], [4, 0], [4, 3], [0, 3]],
        "room_category": {"Kitchen": [[0, 0, 4, 3]], "Hall": [[9, 9, 12, 12]], "Bedroom": [[1, 1, 1, 2]]},
    }
    notes = import_houseexpo(plan, "plan", "plan.json").notes
    assert [note.split(" has ")[0] for note in notes] == ["room_category 'Hall'", "room_category 'Bedroom'"]


def test_a_sound_scene_loads_without_a_warning(tmp_path: Path) -> None:
    (tmp_path / "oak.json").write_text(json.dumps(load_scene("oak").model_dump(mode="json")))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_scene(tmp_path / "oak.json").notes == ()
