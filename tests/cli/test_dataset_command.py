"""Test ``vssm-gym dataset``: a Habitat file is driven, exported and read back; a recording too; errors of one line."""

import gzip
import json
import sys

import numpy as np
import pytest

from tests.helpers.datasets.random_walk import record
from vssm_gym.cli import main as main_module


@pytest.fixture
def vssm(monkeypatch, capsys):
    """Run the console script in this process: ``vssm("dataset", ...) -> (exit code, stdout, stderr)``."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["vssm-gym", *map(str, arguments)])
        code = main_module.main()
        return code, *capsys.readouterr()

    return run


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
    code, out, err = vssm("dataset", "export", tmp_path / "s.yaml", "--format", "minari", "--out", tmp_path / "d")
    assert code == 0, err
    dataset = minari.MinariDataset(tmp_path / "d/data")
    assert out.startswith(f"2 episodes, {dataset.total_steps} steps: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d", "s.yaml", "val.json.gz"]
    assert sorted(path.name for path in (tmp_path / "d").iterdir()) == ["data"]
    wanted = json.loads(gzip.decompress(file.read_bytes()))["episodes"]
    for found, episode in zip(dataset, wanted, strict=True):
        x, _, z = episode["goals"][0]["position"]
        np.testing.assert_allclose(found.observations["goal"][0], [x, -z], rtol=1e-6)
        assert found.observations["depth"].dtype == np.float32 and len(found.observations["rgb"]) == len(found) + 1


@pytest.mark.parametrize(("form", "library"), [("minari", "minari"), ("lerobot", "pyarrow")])
def test_a_recording_is_exported(vssm, tmp_path, form, library):
    pytest.importorskip(library)
    record(tmp_path / "walk")
    code, out, err = vssm("dataset", "export", tmp_path / "walk", "--format", form, "--out", tmp_path / "d")
    assert (code, err) == (0, "")
    assert out.startswith(f"1 episode, 6 steps: {tmp_path / 'd'}\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("export {0}/gone.yaml --out {0}/d", "gone.yaml: file: expected a readable YAML file"),
        ("export {0}/walk --out {0}/walk", "walk: folder: expected a new or empty folder"),
        ("export {0}/empty --out {0}/d", "empty/rgb.txt: file: expected this index file"),
        ("export {0}/walk --map oak --out {0}/d", "dataset: map: expected none with a recording"),
        ("export {0}/walk --seed -1 --out {0}/d", "dataset: seed: expected at least 0, found -1"),
        ("from-habitat {0}/val.json --scene oak --out {0}/t.json", "val.json: episodes: expected a list of PointNav"),
        ("from-habitat {0}/val.json --scene oak --out {0}/t.txt", "t.txt: file: expected a name that ends in .json"),
        ("to-habitat oak --count 0 --out {0}/o.json.gz", "dataset: count: expected at least 1, found 0"),
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
    before = sorted(tmp_path.rglob("*"))
    code, out, err = vssm("dataset", *(word.format(tmp_path) for word in arguments.split()))
    assert (code, out) == (main_module.BAD_INPUT, "")
    assert err.startswith("error: ") and message in err and err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_missing_library_is_one_line(vssm, tmp_path, monkeypatch):
    record(tmp_path / "walk")
    for form, library in (("minari", "minari"), ("lerobot", "pyarrow")):
        monkeypatch.setitem(sys.modules, library, None)
        code, _, err = vssm("dataset", "export", tmp_path / "walk", "--format", form, "--out", tmp_path / "d")
        expected = f"dataset: {library}: expected this library: pip install 'vssm-gym[datasets]'"
        assert (code, err) == (main_module.BAD_INPUT, f"error: {expected}\n")
