"""Test the study of the smoother: its table, how it is continued, and one short walk from end to end."""

import json
import xml.etree.ElementTree as ET
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from vssm_gym.cli.studies import simulated as commands
from vssm_gym.data.sequences import load_sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import page, stored_rows
from vssm_gym.eval.studies.page import write_study
from vssm_gym.eval.studies.smoothing import study as smoothing_study
from vssm_gym.eval.studies.smoothing.comparison import compare
from vssm_gym.eval.studies.smoothing.study import Setting, checked, finished
from vssm_gym.eval.studies.smoothing.table import HEADER, StoredRow, study_of


def measured(**changed: Any) -> dict[str, Any]:
    usual = {"ate_m": 0.01, "max_m": 0.02, "rotation_deg": 0.1, "nees": 2.0, "inside": 0.8, "seconds": 30.0}
    return {**usual, "depth_l1": 0.012, "log_likelihood": 1.5, "hit_share": 0.9, **changed}


def row(after: float = 0.005, **changed: Any) -> dict[str, Any]:
    counts = {"seconds": 20.0, "length_m": 9.0, "frames": 200, "lost": 1, "smoothed_frames": 199}
    smoothed = measured(ate_m=after, nees=1.0, depth_l1=0.011, log_likelihood=1.6)
    return {**counts, "filter": measured(), "smoother": smoothed, **changed}


def test_the_answer_tells_walks_flights_and_recordings_apart_and_where_it_is_worst() -> None:
    rows = {"walk 0, a": row(), "walk 1, b": row(0.011), "flight 0, c": row(0.002), "mine": row(0.004)}
    study = study_of(rows, {"split": "train"})
    assert "Walks: mean ratio of ATE, smoothed to filtered, 0.80 of 2, largest 1.10 (walk 1, b)" in study.answer
    assert "Flights: mean ratio of ATE, smoothed to filtered, 0.20 of 1" in study.answer
    assert "Recordings: mean ratio" in study.answer and "0.40 of 1" in study.answer
    assert "depth is better in 2 and the log-likelihood in 2 of 2" in study.answer
    assert "3.0 times real time" in study.answer
    assert all(len(line) == len(HEADER) for line in study.lines)
    assert ET.fromstring(study.picture) is not None
    json.dumps(study.figures, allow_nan=False)


def test_a_recording_without_images_to_judge_by_has_dashes() -> None:
    blind = dict.fromkeys(("depth_l1", "log_likelihood", "hit_share"))
    study = study_of({"a": row(filter=measured(**blind), smoother=measured(**blind))}, {})
    assert study.lines[0].count("-") == 4
    assert "held out" not in study.answer


@pytest.mark.parametrize(
    "change",
    [{"walks": -1}, {"seed": -1}, {"split": "all"}, {"walks": 0, "flights": 0}, {"rate": 0.0}, {"depth": "lidar"}],
)
def test_a_bad_option_writes_nothing(tmp_path: Path, change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        commands.smoothing(out=tmp_path / "out", **change)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def known_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the version: asking git for it takes longer than the rest."""
    for module in (page, stored_rows):
        monkeypatch.setattr(module, "package_version", lambda: "0.1.0+test")


def test_a_study_is_continued_with_its_own_rows_alone(tmp_path: Path, known_version: None) -> None:
    setting, path = Setting(), tmp_path / "smoothing.json"
    assert finished(path, setting) == {}
    write_study(study_of({"walk 0, fern": row()}, asdict(setting)), tmp_path)
    assert finished(path, setting) == {"walk 0, fern": row()}
    with pytest.raises(InputError, match=r"seed: .*1, as in this study; found 0"):
        finished(path, Setting(seed=1))
    with pytest.raises(InputError, match=r"depth: .*stereo, as in this study; found 'good'"):
        finished(path, Setting(depth="stereo"))
    damaged = json.loads(path.read_text())
    damaged["figures"]["rows"]["walk 0, fern"]["filter"]["nees"] = "small"
    path.write_text(json.dumps(damaged))
    with pytest.raises(InputError, match="nees"):
        finished(path, setting)


@pytest.mark.slow
def test_a_short_walk_is_compared_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two metres through an apartment: every number is there, and the command writes them."""
    monkeypatch.setattr(smoothing_study, "SMOOTHED_METRES", 2.0)
    commands.smoothing(out=tmp_path / "out", walks=1, flights=0)
    stored = json.loads((tmp_path / "out" / "smoothing.json").read_text())
    (name, found), *_ = stored["figures"]["rows"].items()
    assert name == "walk 0, fern"
    StoredRow.model_validate(found)
    assert found["lost"] == 0 and found["length_m"] > 1.9
    assert found["filter"]["log_likelihood"] is not None
    assert 0.0 < found["smoother"]["ate_m"] < 0.02
    assert found["smoother"]["depth_l1"] < 0.05
    assert (tmp_path / "out" / "smoothing.html").is_file()


def test_a_recording_without_ground_truth_is_refused(shared_data: Path) -> None:
    recording = load_sequence(shared_data / "tum_fr1_xyz")
    unknown = type(recording)(**{**vars(recording), "truth": None})
    with pytest.raises(InputError, match=r"groundtruth\.txt"):
        checked([unknown], Setting())
    with pytest.raises(InputError, match=r"groundtruth\.txt"):
        compare(unknown, smoothing_study.WALK_OPTIONS)
    with pytest.raises(InputError, match="different names"):
        checked([recording, recording], Setting())
