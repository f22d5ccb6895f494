"""Test rows of studies run again: the committed ones can be, equal ones pass, and an altered one is named."""

import json
import re

import pytest

from tests.helpers.paths import BASELINES
from vssm_gym.cli.sweeps.reproduce import reproduce
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.measure import measure
from vssm_gym.eval.bench.prediction.models import models
from vssm_gym.eval.bench.prediction.run import HORIZONS
from vssm_gym.eval.reproduction import prediction_rows
from vssm_gym.eval.reproduction.studies import STUDIES
from vssm_gym.eval.studies.calibration import study as calibration
from vssm_gym.eval.studies.maze_exploration.run import ExplorationSetting
from vssm_gym.eval.studies.maze_exploration.run import run as run_exploration
from vssm_gym.eval.studies.maze_slam.run import MazeSlamSetting
from vssm_gym.eval.studies.maze_slam.run import run as run_maze_slam
from vssm_gym.eval.studies.page import write_study

STUDY_FOLDERS = {
    "maze_slam": "maze-slam",
    "maze_exploration": "maze-exploration",
    "slam2d_strips": "slam2d by strips",
    "slam2d_graph": "slam2d by a pose graph",
}


@pytest.mark.parametrize("folder", STUDY_FOLDERS)
def test_committed_rows_of_a_study_are_of_one_kind(folder):
    """The rows of each study can be run again, but for two of recorded logs."""
    (kind,) = [kind for kind in STUDIES if kind.rows(BASELINES / folder)]
    assert kind.name == STUDY_FOLDERS[folder]
    lines = len((BASELINES / folder / kind.file).read_text().splitlines())
    assert len(kind.rows(BASELINES / folder)) == lines - (2 if folder == "slam2d_graph" else 0)


RUNS = {
    "maze-slam.jsonl": lambda out: run_maze_slam(
        MazeSlamSetting(("rings-v1",), ("odometry",), traversals=3, seeds=1, steps=150), out
    ),
    "maze-exploration.jsonl": lambda out: run_exploration(
        ExplorationSetting(("rings-v1",), ("maze_random",), seeds=2, steps=25), out
    ),
}


@pytest.mark.parametrize("file", RUNS)
def test_rows_of_a_study_are_run_again_and_an_altered_one_is_named(file, tmp_path, capsys):
    study = tmp_path / "study"
    study.mkdir()
    ran = RUNS[file](study)
    reproduce(study, tmp_path / "again")
    assert f"{len(ran)} of {len(ran)} rows have the same outcome" in capsys.readouterr().out
    lines = (study / file).read_text().splitlines()
    assert len((tmp_path / "again" / file).read_text().splitlines()) == len(lines)
    row = json.loads(lines[-1])
    name = "mean" if "mean" in row else "path_length"
    (study / file).write_text("\n".join([*lines[:-1], json.dumps(row | {name: row[name] + 0.01})]) + "\n")
    with pytest.raises(SystemExit):
        reproduce(study, tmp_path / "altered")
    assert re.search(rf"maze rings-v1, .*: {name}: expected", capsys.readouterr().out)


TABLE_ROWS = {"calibration": 22, "smoothing": 24, "relocalisation": 6}  # rows of recordings apart


@pytest.mark.parametrize("folder", TABLE_ROWS)
def test_committed_rows_of_a_table_can_be_run_again(folder):
    (kind,) = [kind for kind in STUDIES if kind.rows(BASELINES / folder)]
    rows = kind.rows(BASELINES / folder)
    assert kind.name == folder and len({row["row"] for row in rows}) == len(rows) == TABLE_ROWS[folder]
    assert all(len(row.keys() - {"row", "setting"}) > 1 for row in rows)
    assert "seconds" not in json.dumps([{name: row[name] for name in row.keys() - {"row", "setting"}} for row in rows])


CALIBRATED = calibration.Setting(runs=1)


def calibration_study(out):
    """Write the calibration of two rows without a map, of one run each."""
    for study in calibration.run(
        [], calibration.chosen("dead-reckoning-l*,dead-reckoning-h*"), CALIBRATED, folder=out, done={}
    ):
        write_study(study, out)


def test_rows_of_a_table_are_run_again_and_an_altered_one_is_named(tmp_path, capsys):
    study = tmp_path / "study"
    study.mkdir()
    calibration_study(study)
    reproduce(study, tmp_path / "again")
    assert "2 of 2 rows have the same outcome" in capsys.readouterr().out
    stored = json.loads((study / "calibration.json").read_text())
    stored["figures"]["rows"]["dead-reckoning-high"]["nees"]["mean"] *= 1.1
    (study / "calibration.json").write_text(json.dumps(stored))
    with pytest.raises(SystemExit):
        reproduce(study, tmp_path / "altered")
    with pytest.raises(SystemExit):  # the rows that are there are kept
        reproduce(study, tmp_path / "again", resume=True)
    assert len((tmp_path / "again" / "calibration.jsonl").read_text().splitlines()) == 2
    assert capsys.readouterr().out.count("row dead-reckoning-high: nees.mean: expected") == 2
    rows = stored["figures"].pop("rows")
    (study / "calibration.json").write_text(json.dumps(stored))
    with pytest.raises(InputError, match=r"figures\.rows: expected the rows of a study"):
        reproduce(study, tmp_path / "without")
    stored["figures"]["rows"] = rows
    stored["setting"]["more"] = 1
    (study / "calibration.json").write_text(json.dumps(stored))
    with pytest.raises(InputError, match=r"setting: expected that of a study"):
        reproduce(study, tmp_path / "refused")


def test_committed_predictions_can_be_run_again_and_recorded_motions_are_left_out():
    (kind,) = [kind for kind in STUDIES if kind.rows(BASELINES / "prediction")]
    rows = kind.rows(BASELINES / "prediction")
    assert [row["model"] for row in rows] == [model.name for model in models()]
    assert all([part["seconds"] for part in row["horizons"]] == list(HORIZONS) for row in rows)


@pytest.mark.slow
def test_predictions_are_made_again_and_an_altered_score_is_named(tmp_path, capsys, monkeypatch):
    last = models()[-1]  # the cheapest
    monkeypatch.setattr(prediction_rows, "models", lambda: [last])
    study = tmp_path / "study"
    study.mkdir()
    found = measure(split="train", runs=1, seed=3, folder=tmp_path, candidates=[last])
    (study / "test.json").write_text(json.dumps(found))
    reproduce(study, tmp_path / "again")
    assert "1 of 1 rows have the same outcome" in capsys.readouterr().out
    found["rows"][1]["nats"]["mean"] += 0.02
    (study / "test.json").write_text(json.dumps(found))
    with pytest.raises(SystemExit):
        reproduce(study, tmp_path / "altered")
    assert f"model {last.name}: horizons[1].nats.mean: expected" in capsys.readouterr().out
    found["rows"][0]["model"] = "nobody"
    (study / "test.json").write_text(json.dumps(found))
    with pytest.raises(InputError, match="model: expected"):
        reproduce(study, tmp_path / "refused")
    (study / "test.json").write_text(json.dumps(found | {"setting": {}}))
    with pytest.raises(InputError, match="setting: expected that of bench prediction"):
        reproduce(study, tmp_path / "without")
