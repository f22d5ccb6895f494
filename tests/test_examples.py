"""Run every program of ``examples/`` as a newcomer does, in an empty folder; and the cells of the notebook."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from vssm_gym.maps.voxel_map import VoxelMap

CHECKOUT = Path(__file__).resolve().parents[1]
EXAMPLES = CHECKOUT / "examples"
NOTEBOOK = EXAMPLES / "tour.ipynb"
# program: arguments, files that it leaves, what it says in the end
PROGRAMS = {
    "drive": ([], ["drive.gif"], r"success True, SPL 0\.\d\d"),
    "export_sb3": (["8192"], ["mine.npz", "mine.yaml"], r"within \de-0[6-9](?s:.*)policy:.*mine\.npz"),
    "imagine": ([], ["imagine.png"], r"\d+ episodes, (9\d|100)% of them arrived"),
    "map_and_plan": ([], ["room.npz", "room.png"], r"a path of \d\.\d\d m"),
    "own_agent": ([], ["compared/*/episodes.jsonl"], r"oracle +task 2: success True"),
    "slam": ([], ["trajectory.txt", "map.npz"], r"s  ok    stds \[\d"),
    "train_ppo": (
        ["0.3"],
        ["ppo_pointnav.zip"],
        r"random actions: \d+% success, SPL \d\.\d\d in 16 (?s:.*)steps: \d+.*\n.*PPO\.load",
    ),
}


def test_every_example_is_run():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == PROGRAMS.keys()
    assert [path for path in EXAMPLES.iterdir() if path.suffix not in (".py", ".md", ".ipynb")] == []


@pytest.mark.parametrize(("argument", "code"), [("--help", 0), ("no_such_agent", 2)])
def test_the_drive_names_its_agents(argument, code):
    command = [sys.executable, str(EXAMPLES / "drive.py"), argument]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == code and "policy:oak" in said and "astar" in said and "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_an_example(name, tmp_path):
    arguments, files, said = PROGRAMS[name]
    if name in ("export_sb3", "train_ppo"):
        pytest.importorskip("stable_baselines3", reason="needs the extra rl")
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.search(said, done.stdout), done.stdout[-2000:]
    assert all(path.stat().st_size > 0 for file in files for path in [*tmp_path.glob(file)] or [tmp_path / file])
    if name == "map_and_plan":
        assert VoxelMap.load(tmp_path / "room.npz").voxel_size == pytest.approx(0.07)


@pytest.mark.slow
def test_the_cells_of_the_notebook_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "tour"}
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert names["found"].found
    assert names["info"]["success"]


def test_the_notebook_was_run_to_its_end():
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(output["output_type"] != "error" for cell in cells for output in cell["outputs"])
    assert NOTEBOOK.stat().st_size < 400_000
