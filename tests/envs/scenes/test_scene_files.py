"""Test scene files: formats are detected, reading is bounded, and damaged houses are refused or valid."""

import gzip
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings

from tests.envs.scenes.test_procthor import ASSETS, broken, imported, small_house, vec
from tests.helpers.damage import damaged_json, valid_or_refused
from tests.helpers.paths import SHARED_DATA
from tests.helpers.scene_checks import check_scene
from vssm_gym.envs.scenes.importers.procthor import import_procthor, read_assets
from vssm_gym.envs.scenes.scene import ASSETS as BUILT_IN
from vssm_gym.envs.scenes.scene import load_scene, parse_apartment, save_scene
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json_line

DATA = SHARED_DATA / "procthor"
LINES = DATA / "one_room_40.jsonl.gz"
needs_data = pytest.mark.skipif(not LINES.is_file(), reason="the procthor files are not on this machine")
DATABASE = {"DiningTable": [{"assetId": "Table_1", "objectType": "DiningTable", "boundingBox": vec(1.6, 0.8, 0.9)}]}


def houses(folder: Path, name: str, number: int = 3) -> Path:
    """Return houses without objects, one a line: the first without a name, the others with a wider room."""
    (folder / "asset-database.json").write_text(json.dumps(DATABASE))
    house = small_house() | {"objects": []}
    text = "".join(json.dumps(house | {"metadata": {"warnings": {"Line": str(i)}}}) + "\n" for i in range(number))
    content = text.encode()
    (folder / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    return folder / name


@pytest.mark.parametrize("name", ["few.jsonl", "few.jsonl.gz"])
def test_a_line_is_a_house(tmp_path: Path, name: str) -> None:
    path = houses(tmp_path, name)
    flat = load_scene(f"{path}#2")
    assert flat.name == "few#2"
    assert flat.notes == ("Line: 2",)
    save_scene(flat, tmp_path / "flat.json")
    assert load_scene(tmp_path / "flat.json").content_hash() == flat.content_hash()


@pytest.mark.parametrize(
    ("ending", "expected"),
    [("", "as in few.jsonl.gz#0"), ("#3", "below 3"), ("#999999999999", "below 1,000,000"), ("#x", "built-in")],
)
def test_missing_lines_are_refused(tmp_path: Path, ending: str, expected: str) -> None:
    path = houses(tmp_path, "few.jsonl.gz")
    with pytest.raises(InputError, match="expected") as caught:
        load_scene(f"{path}{ending}")
    assert expected in caught.value.expected


def test_unpacking_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bomb.jsonl.gz").write_bytes(gzip.compress(bytes([97]) * 30_000_000))
    monkeypatch.setattr("vssm_gym.files.json_file.JSON_BYTES", 1_000_000)
    with pytest.raises(InputError, match="at most 1,000,000 bytes"):
        read_json_line(tmp_path / "bomb.jsonl.gz", 0)
    (tmp_path / "lines.jsonl.gz").write_bytes(gzip.compress(b"[1]\n" * 1_000_000))
    monkeypatch.setattr("vssm_gym.files.json_file.LINES_BYTES", 1_000_000)
    with pytest.raises(InputError, match="1,000,000 in all"):
        read_json_line(tmp_path / "lines.jsonl.gz", 900_000)


@pytest.mark.parametrize(
    "content",
    [b"", b"no gzip", gzip.compress(b'{"a": 1}')[:-9], gzip.compress(b"\xff\xfe")],
    # gzip writes the time of day into its header: as an id it would differ between workers.
    ids=["empty", "no gzip", "cut off", "not UTF-8"],
)
def test_damaged_archives_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "few.jsonl.gz").write_bytes(content)
    with pytest.raises(InputError):
        load_scene(f"{tmp_path / 'few.jsonl.gz'}#0")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[" * 100_000, "nested at most"),
        ("1" * 5000, "whole numbers below"),
        ("{", "valid JSON"),
        ('{"rooms": NaN}', "finite"),
        ("[]", "a JSON object"),
        ('{"verts": []}', "at least 3"),
        ('{"name": "x"}', "present"),
    ],
)
def test_bad_json_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path / "scene.json")
    assert expected in caught.value.expected


# ---- ProcTHOR


def sized(x: float, y: float, z: float) -> dict[str, Any]:
    entry = {"assetId": "Table_1", "objectType": "DiningTable", "boundingBox": vec(x, y, z)}
    return dict(ASSETS) | dict(read_assets({"DiningTable": [entry]}, "assets"))


@pytest.mark.parametrize(
    ("where", "value", "field", "expected"),
    [
        ("rooms.0.floorPolygon", [], "rooms[0].floorPolygon", "at least 3"),
        ("rooms.0.floorPolygon", [vec(0, 0, 0)] * 3, "rooms[0].polygon", ""),
        ("rooms.0.floorPolygon.1.x", 1e7, "rooms[0].floorPolygon[1].x", "less than or equal"),
        ("objects.0.position.y", -1e12, "objects[0].position.y", "greater than or equal"),
        ("objects.0.rotation.y", 1e300, "objects[0].rotation.y", "less than or equal"),
        ("objects.0.id", "x" * 1000, "objects[0].id", "at most 200"),
        ("walls", small_house()["walls"][:1] * 6000, "walls", "at most 5000"),
        ("walls.0.polygon.2.y", 1e6, "walls[0].polygon[2].y", "less than or equal"),
    ],
)
def test_houses_out_of_bounds(where: str, value: Any, field: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        imported(broken(where, value))
    assert caught.value.field == field
    assert expected in caught.value.expected


def test_objects_without_size_are_refused() -> None:
    for size in ((0, 0, 0), (1, 0, 0)):
        with pytest.raises(InputError, match="an asset with a size; 'Table_1' has none"):
            import_procthor(small_house(), sized(*size), "small", "small.json")
    with pytest.raises(InputError, match=r"boundingBox\.x"):
        sized(-1, 1, 1)
    flat = import_procthor(small_house(), sized(1, 0, 1), "small", "small.json")  # a sheet of paper
    assert flat.furniture[0].boxes[0].size == (1, 1, 1e-3)


def test_objects_outside_are_named() -> None:
    house = small_house()
    house["objects"][0]["position"] = vec(20, 0.4, 1)
    house["objects"][0]["children"][0]["position"] = vec(2, 9, 1)
    house["objects"][1]["position"] = vec(2, -4, 1)
    notes = imported(house).notes
    assert notes[1:] == ("table is outside the walls", "cup is above the ceiling", "picture is under the floor")


def test_children_are_bounded() -> None:
    house = small_house()
    child: dict[str, Any] = {"id": "c", "assetId": "Cup_1", "position": vec(1, 1, 1), "rotation": vec(0, 0, 0)}
    house["objects"][0]["children"] = [child | {"children": [child] * 80}] * 80
    with pytest.raises(InputError, match="at most 5,000 objects"):
        imported(house)
    for _ in range(500):
        child = child | {"children": [child]}
    house["objects"] = [child]
    valid_or_refused(lambda: imported(house))


@given(damaged_json(small_house()))
@settings(max_examples=250, deadline=None)
def test_damaged_houses(data: Any) -> None:
    valid_or_refused(lambda: import_procthor(data, ASSETS, "damaged", "damaged.json"))


@given(damaged_json(DATABASE))
@settings(max_examples=50, deadline=None)
def test_damaged_databases(data: Any) -> None:
    house = small_house()
    house["objects"] = [house["objects"][0] | {"children": []}]
    valid_or_refused(lambda: import_procthor(house, read_assets(data, "assets"), "damaged", "damaged.json"))


@given(damaged_json({**json.loads((BUILT_IN / "oak.json").read_text()), "furniture": []}))
@settings(max_examples=150, deadline=None)
def test_damaged_scenes_of_our_own(data: Any) -> None:
    valid_or_refused(lambda: parse_apartment(data, "damaged.json"))


@needs_data
@pytest.mark.parametrize("line", range(0, 40, 5))
def test_one_room_houses(line: int) -> None:
    check_scene(load_scene(f"{LINES}#{line}"), steps=10)


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize("line", range(40))
def test_every_one_room_house(line: int) -> None:
    space = check_scene(load_scene(f"{LINES}#{line}"))
    assert space.cut_off_rooms() == []
