"""Test the lists of scenes for navigation in unknown homes: classes and splits, and other scenes in their place."""

import gzip
import json
from pathlib import Path

import pytest

from tests.envs.scenes.test_procthor import small_house
from tests.helpers.paths import CHECKOUT
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.envs.tasks.splits import split_of
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.config import expand, load_config
from vssm_gym.eval.sweep.runner import run_sweep

CONFIGS = CHECKOUT / "eval" / "configs"
CLASSES = {"small": (1, 3, "test"), "medium": (4, 7, "test"), "train": (1, 7, "train")}


@pytest.mark.slow
@pytest.mark.parametrize("kind", CLASSES)
def test_a_list_holds_scenes_of_its_class_and_split(kind: str) -> None:
    config = load_config(CONFIGS / f"slam_nav_{kind}.yaml")
    fewest, most, split = CLASSES[kind]
    assert len(config.scenes) >= 20
    assert {split_of(scene) for scene in config.scenes} == {split}
    assert all(fewest <= len(load_scene(scene).rooms) <= most for scene in config.scenes)


def houses(folder: Path) -> Path:
    """Write a file of two houses, one a line."""
    (folder / "asset-database.json").write_text(
        json.dumps({"DiningTable": [{"assetId": "Table_1", "objectType": "DiningTable", "boundingBox": {}}]}).replace(
            "{}", '{"x": 1.6, "y": 0.8, "z": 0.9}'
        )
    )
    lines = 2 * (json.dumps(small_house() | {"objects": []}) + "\n")
    (folder / "houses.jsonl.gz").write_bytes(gzip.compress(lines.encode()))
    return folder / "houses.jsonl.gz"


@pytest.mark.slow
def test_houses_of_one_file_are_swept_under_names_of_their_own(tmp_path: Path) -> None:
    """Each house is a line of the file: rows, tasks and maps are named after file and line."""
    houses(tmp_path)
    (tmp_path / "sweep.yaml").write_text(
        "scenes: ['houses.jsonl.gz#0', 'houses.jsonl.gz#1']\nagents: random\nnoise: mid\ntasks: 1\n"
    )
    log = run_sweep(load_config(tmp_path / "sweep.yaml"), tmp_path / "out", workers=1)
    assert [json.loads(line)["scene"] for line in log.read_text().splitlines()] == ["houses-0", "houses-1"]
    assert sorted(path.name for path in (tmp_path / "out" / "tasks").iterdir()) == [
        "houses-0-holonomic.json",
        "houses-1-holonomic.json",
    ]


def test_houses_of_one_file_have_names_of_their_own(tmp_path: Path) -> None:
    houses(tmp_path)
    (tmp_path / "sweep.yaml").write_text(
        "scenes: ['houses.jsonl.gz#0', 'houses.jsonl.gz#1']\nagents: random\ntasks: 2\n"
    )
    episodes = list(expand(load_config(tmp_path / "sweep.yaml")))
    assert [episode.identity("")["scene"] for episode in episodes] == ["houses-0", "houses-0", "houses-1", "houses-1"]


def test_a_house_of_a_missing_file_is_refused_before_anything_runs(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text("scenes: 'houses.jsonl.gz#0'\nagents: random\ntasks: 1\n")
    with pytest.raises(InputError, match=r"sweep\.yaml: scenes: .*an existing file"):
        load_config(tmp_path / "sweep.yaml")


def test_scenes_of_the_command_take_the_place_of_the_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative paths on the command line start at the working folder, those in the file at the file."""
    path = CONFIGS / "slam_nav_small.yaml"
    house = houses(tmp_path)
    monkeypatch.chdir(tmp_path)
    config = load_config(path, ("oak", "houses.jsonl.gz#1"))
    assert config.scenes == ("oak", f"{house.resolve()}#1")
    assert config.model_copy(update={"scenes": ()}) == load_config(path).model_copy(update={"scenes": ()})
    for scenes, expected in (
        (("oak", "oak"), "differ"),
        (("nowhere.json",), "an existing file"),
        (("procedural:x",), "procedural:SEED"),
        (("",), "printable"),
    ):
        with pytest.raises(InputError, match=expected):
            load_config(path, scenes)


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        ("oak", "oak"),
        ("procedural:7", "procedural-7"),
        ("procedural:7:small", "procedural-7-small"),
        ("/a/house_1.json", "house_1"),
        ("/a/houses.jsonl.gz#7", "houses-7"),
        ("houses.jsonl#12", "houses-12"),
        ("plan#3.json", "plan#3"),
    ],
)
def test_names_of_scenes(spec: str, name: str) -> None:
    assert scene_name(spec) == name
