"""Test ``vssm-gym dataset``: a Habitat file is driven, exported and read back; a recording too; errors of one line."""

import gzip
import json
import re
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.helpers.datasets.random_walk import record
from tests.helpers.paths import CHECKOUT
from vssm_gym.cli import main as main_module
from vssm_gym.cli.datasets.given_map import check_given_map
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks import habitat
from vssm_gym.envs.tasks.navigation import task_set
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.maps.voxel_map import VoxelMap


def test_habitat_files_come_and_go(vssm, tmp_path):
    first, tasks, back = (tmp_path / name for name in ("a.json.gz", "tasks.json", "b.json.gz"))
    assert vssm("dataset", "to-habitat", "oak", "--count", 4, "--out", first)[1] == f"4 episodes: {first}\n"
    content = json.loads(gzip.decompress(first.read_bytes()))
    content["episodes"][1]["start_position"][1] = 0.2  # a height, and a field that is not known here
    content["episodes"][1]["own"] = [1, None]
    first.write_bytes(gzip.compress(json.dumps(content).encode()))
    code, out, _ = vssm("dataset", "from-habitat", first, "--scene", "oak", "--out", tasks)
    assert code == 0 and out.startswith(f"4 tasks of oak: {tasks}\n")
    code, out, _ = vssm("dataset", "to-habitat", "oak", "--tasks", tasks, "--template", first, "--out", back)
    assert code == 0 and json.loads(gzip.decompress(back.read_bytes())) == content


def test_episodes_of_a_habitat_file_are_exported_and_read_back(vssm, tmp_path):
    """Drive two tasks of a Habitat file, and find its goals in the data set."""
    minari = pytest.importorskip("minari")
    file = tmp_path / "val.json.gz"
    vssm("dataset", "to-habitat", "oak", "--count", 2, "--out", file)
    (tmp_path / "s.yaml").write_text("scenes: oak\nagents: random\ntasks: 2\ntask_file: val.json.gz\n")
    code, out, err = vssm("dataset", "export", tmp_path / "s.yaml", "--format", "minari", "--out", tmp_path / "d-v0")
    assert code == 0, err
    dataset = minari.MinariDataset(tmp_path / "d-v0/data")
    assert out.startswith(f"2 episodes, {dataset.total_steps} steps: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d-v0", "s.yaml", "val.json.gz"]
    assert sorted(path.name for path in (tmp_path / "d-v0").iterdir()) == ["data"]
    wanted = json.loads(gzip.decompress(file.read_bytes()))["episodes"]
    for found, episode in zip(dataset, wanted, strict=True):
        x, _, z = episode["goals"][0]["position"]
        np.testing.assert_allclose(found.observations["goal"][0], [x, -z], rtol=1e-6)
        assert found.observations["depth"].dtype == np.float32 and len(found.observations["rgb"]) == len(found) + 1


@pytest.mark.parametrize(("form", "library"), [("minari", "minari"), ("lerobot", "pyarrow")])
def test_a_recording_is_exported(vssm, tmp_path, form, library):
    pytest.importorskip(library)
    record(tmp_path / "walk")
    code, out, err = vssm("dataset", "export", tmp_path / "walk", "--format", form, "--out", tmp_path / "d-v0")
    assert (code, err) == (0, "")
    assert out.startswith(f"1 episode, 6 steps: {tmp_path / 'd-v0'}\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("export {0}/walk --out {0}/few", "few: name: expected the id of a data set of Minari"),
        ("export {0}/s.yaml --map oak --out {0}/d-v0", "oak: scene: expected a configuration of scene oak, of which"),
        ("export {0}/gone.yaml --out {0}/d-v0", "gone.yaml: file: expected a readable YAML file"),
        ("export {0}/walk --out {0}/walk", "walk: folder: expected a new or empty folder"),
        ("export {0}/empty --out {0}/d-v0", "empty/rgb.txt: file: expected this index file"),
        ("export {0}/walk --map oak --out {0}/d-v0", "dataset: map: expected none with a recording"),
        ("export {0}/walk --seed -1 --out {0}/d-v0", "dataset: seed: expected at least 0, found -1"),
        ("from-habitat {0}/val.json --scene oak --out {0}/t.json", "val.json: episodes: expected a list of PointNav"),
        ("from-habitat {0}/val.json --scene oak --out {0}/t.txt", "t.txt: file: expected a name that ends in .json"),
        ("to-habitat oak --count 0 --out {0}/o.json.gz", "dataset: count: expected at least 1, found 0"),
        ("to-habitat oak --count 100001 --out {0}/o.json.gz", "dataset: count: expected at most 100,000, so that"),
        ("to-habitat oak --scene-id a --out {0}/o.json.gz", "dataset: scene_id: expected none without a template"),
        ("to-habitat oak --out {0}/val.json", "val.json: file: expected a new file: this one is never overwritten"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(vssm, tmp_path, arguments, message):
    if arguments.startswith("export"):
        pytest.importorskip("minari")
    record(tmp_path / "walk")
    (tmp_path / "empty").mkdir()
    (tmp_path / "val.json").write_text("{}")
    (tmp_path / "s.yaml").write_text("scenes: cedar\nagents: random\ntasks: 1\n")
    before = sorted(tmp_path.rglob("*"))
    code, out, err = vssm("dataset", *(word.format(tmp_path) for word in arguments.split()))
    assert (code, out) == (main_module.BAD_INPUT, "")
    assert err.startswith("error: ") and message in err and err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def given_map(tmp_path, scene, env="vssm_gym/PointNav-v0", **stated):
    """Check the map of oak for a configuration, in a file that states this of its scene."""
    VoxelMap.load(shipped("oak", MAPS)).save(tmp_path / "m.npz", **stated)
    config = SweepConfig(env=(env,), scenes=(scene,), agents=("random",), tasks=(0,))
    return check_given_map(config, tmp_path / "m.npz")


def test_a_map_of_another_scene_is_refused_by_its_hash(tmp_path):
    hashes = {scene: load_scene(scene).content_hash() for scene in ("oak", "cedar", "procedural:3:parking")}
    assert given_map(tmp_path, "oak", scene_hash=hashes["oak"]) is None
    before = hashes["procedural:3:parking"]  # in which a sweep learns the map
    assert given_map(tmp_path, "procedural:3:parking-moved", "vssm_gym/CarNav-v1", scene_hash=before) is None
    with pytest.raises(InputError, match=rf"scene_hash: expected a map of scene cedar \({hashes['cedar']}\); this one"):
        given_map(tmp_path, "cedar", scene_hash=hashes["oak"])


def test_a_map_that_states_no_scene_is_looked_at(tmp_path):
    assert given_map(tmp_path, "oak") is None
    assert "in this scene: is it a map of this scene?" in given_map(tmp_path, "cedar")
    assert given_map(tmp_path, "cedar", "vssm_gym/Explore-v0") is None


@pytest.mark.parametrize("arguments", ["to-habitat oak --out {}", "from-habitat f.json --scene oak --out {}"])
def test_an_interrupted_conversion_says_that_nothing_is_kept(vssm, tmp_path, monkeypatch, arguments):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(habitat, "write_habitat", interrupt)
    monkeypatch.setattr(habitat, "read_habitat", interrupt)
    words = ["dataset", *arguments.format(tmp_path / "x.json").split()]
    code, out, err = vssm(*words)
    assert (code, out, list(tmp_path.iterdir())) == (130, "", [])
    again = f"interrupted: no result of this run is kept; start it again with: vssm-gym {' '.join(words)}\n"
    assert err.splitlines(keepends=True)[-1] == again


def test_conversion_shows_its_progress(vssm, tmp_path):
    lines = vssm("dataset", "to-habitat", "oak", "--count", 3, "--out", tmp_path / "x.json")[2].splitlines()
    assert [line.rpartition(",")[0] for line in lines] == [
        "progress: drawing tasks: 3 of 3",
        "progress: writing episodes: 3 of 3",
    ]


def snippet(word):
    """Return the block of the page about data sets that contains a word, compiled; it needs a data set to run."""
    blocks = re.findall(r"^```\n(.*?)^```", (CHECKOUT / "docs/datasets.md").read_text(), re.M | re.S)
    [block] = [block for block in blocks if word in block]
    return compile(block, "datasets.md", "exec")


def test_the_page_makes_an_episode_again(vssm, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text("scenes: oak\nagents: random\ntasks: 1\n")
    assert vssm("dataset", "export", "s.yaml", "--out", "demo-v0")[0] == 0
    names: dict[str, Any] = {}
    exec(snippet("import h5py"), names)
    assert len(names["actions"]) + 1 == len(names["depths"]) > 1
    assert names["terminated"] or names["truncated"]


def test_the_page_reads_the_layout_of_lerobot_by_arrow(vssm, tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    colours, _ = record(tmp_path / "walk")
    assert vssm("dataset", "export", "walk", "--format", "lerobot", "--out", "walk-lerobot")[0] == 0
    names: dict[str, Any] = {}
    exec(snippet("import pyarrow"), names)
    np.testing.assert_array_equal(names["rgb"], colours[:-1])
    stored = [np.array(Image.open(path)) for path in sorted((tmp_path / "walk/depth").iterdir())]
    np.testing.assert_array_equal(names["depth"], stored)
    assert names["depth"].dtype == np.uint16 and names["metadata"]["recording"] == "walk"
    assert names["actions"].shape == (6, 3) and names["rewards"].shape == (6,)


def test_the_page_for_those_who_come_from_habitat_states_our_conversion():
    text = (CHECKOUT / "docs/coming_from.md").read_text()
    [formulas] = re.findall(r"^    (x = .*heading = .*)$", text, re.M)
    x, y, heading = (part.partition("=")[2].replace("pi", "np.pi") for part in formulas.split(",  "))
    for task in task_set(load_scene("oak"), HolonomicRobot(), "test", 5).tasks:
        position, (_, q_y, _, q_w) = habitat.to_habitat(task.start[:2]), habitat.rotation_of(task.start[2])
        names = {"X": position[0], "Z": position[2], "q_y": q_y, "q_w": q_w, "atan2": np.arctan2, "np": np}
        found = [eval(one.replace("2 atan2", "2 * atan2"), names) for one in (x, y, heading)]
        np.testing.assert_allclose(found[:2], task.start[:2])
        assert abs(wrap_angle(found[2] - task.start[2])) < 1e-9


def test_a_missing_library_is_one_line(vssm, tmp_path, monkeypatch):
    record(tmp_path / "walk")
    for form, library in (("minari", "minari"), ("lerobot", "pyarrow")):
        monkeypatch.setitem(sys.modules, library, None)
        code, _, err = vssm("dataset", "export", tmp_path / "walk", "--format", form, "--out", tmp_path / "d-v0")
        expected = f"dataset: {library}: expected this library: pip install -c constraints.txt '.[datasets]'"
        assert (code, err) == (main_module.BAD_INPUT, f"error: {expected}\n")
