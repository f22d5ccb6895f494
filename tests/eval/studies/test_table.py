"""Test the calibration table: its cells, its sentence, its page, and how a study of it is continued."""

import json
import xml.etree.ElementTree as ET
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from vssm_gym.cli.studies import recordings as commands
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import page, stored_rows
from vssm_gym.eval.studies.calibration import study as calibration_study
from vssm_gym.eval.studies.calibration.errors import FilterErrors, RunErrors, summarise
from vssm_gym.eval.studies.calibration.rows import ROWS, Row
from vssm_gym.eval.studies.calibration.split import DIVISIONS, seed_of
from vssm_gym.eval.studies.calibration.stored import finished
from vssm_gym.eval.studies.calibration.study import Setting, chosen
from vssm_gym.eval.studies.calibration.table import HEADER, line_of, study_of
from vssm_gym.eval.studies.page import write_study


def runs_of(scale: float, count: int = 12) -> list[RunErrors]:
    """Draw runs of a body in space whose errors are ``scale`` stds."""
    rng = np.random.default_rng(0)
    covariances = np.tile(1e-4 * np.eye(6), (30, 1, 1))
    runs = []
    for _ in range(count):
        errors = FilterErrors(1e-2 * scale * rng.normal(size=(30, 6)), covariances, 30, 0, True)
        runs.append(RunErrors(errors, (errors.last_nees,)))
    return runs


def a_row(scale: float = 1.0) -> dict:
    return summarise(runs_of(scale)) | {"about": "a filter"}


def test_the_answer_says_which_covariances_are_wrong_and_the_cells_are_complete() -> None:
    rows = {"small": a_row(2.0), "large": a_row(0.5), "right": a_row()}
    real = a_row() | {"about": "explains 12 %", "nuisances": {"delay_s": 0.01, "first_pose": [0.0] * 6}}
    lost = summarise([RunErrors(FilterErrors(np.zeros((0, 3)), np.zeros((0, 3, 3)), 9, 9, False), (None,))])
    study = study_of(rows | {"room, clock": real, "gone": lost | {"about": "lost"}}, {"split": "train"}, ("a notice",))
    assert "too small: small (4." in study.answer
    assert "too large: large (0.2" in study.answer
    assert "not shown to be wrong: right (" in study.answer
    assert study.answer.endswith("room, clock: explains 12 %.")
    assert all(len(line) == len(HEADER) for line in study.lines)
    assert line_of("gone", lost) == ["gone", "1", "9", "9", "-", "-", "0 (1 lost)", "-", "-", "-", "-"]
    assert ET.fromstring(study.picture) is not None
    assert study.notes[-1] == "a notice"
    json.dumps(study.figures, allow_nan=False)


def test_no_scene_and_no_seed_is_in_both_splits() -> None:
    train, test = DIVISIONS["train"], DIVISIONS["test"]
    for field in ("apartments", "mapped", "arenas", "flights"):
        assert not set(getattr(train, field)) & set(getattr(test, field))
    seeds = {split: {seed_of(split, s, n) for s in range(3) for n in range(300)} for split in DIVISIONS}
    assert {one % 2 for one in seeds["train"]} == {0}
    assert {one % 2 for one in seeds["test"]} == {1}
    assert {len(one) for one in seeds.values()} == {900}


def test_rows_are_chosen_by_patterns() -> None:
    assert chosen("*") == tuple(ROWS)
    assert chosen("known-map-*, hand-held-exact") == (
        "hand-held-exact",
        "known-map-low",
        "known-map-mid",
        "known-map-high",
    )
    assert chosen("") == ()
    with pytest.raises(InputError, match="walking"):
        chosen("walking-*")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [({"runs": 0}, "runs"), ({"seed": -1}, "seed"), ({"rows": "x"}, "rows"), ({"rows": ""}, "rows or sequences")],
)
def test_a_bad_option_writes_nothing(tmp_path: Path, change: dict, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        commands.calibration(out=tmp_path / "out", **change)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def known_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the version: asking git for it takes longer than the rest."""
    for module in (page, stored_rows):
        monkeypatch.setattr(module, "package_version", lambda: "1.0")


@pytest.mark.usefixtures("known_version")
def test_an_interrupted_study_keeps_its_rows_and_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every finished row is on the page at once; ``--resume`` measures the others, with the same setting only."""
    measured = []

    def measure(name: str, fails: bool = False) -> Row:
        def runs(given: object) -> list[RunErrors]:
            measured.append(name)
            if fails:
                raise KeyboardInterrupt
            return runs_of(1.0, given.runs)  # type: ignore[attr-defined]

        return Row(3, runs, name)

    rows = {"first": measure("first"), "second": measure("second", fails=True)}
    monkeypatch.setattr(calibration_study, "ROWS", rows)
    with pytest.raises(KeyboardInterrupt, match=r"calibration\.json"):
        commands.calibration(out=tmp_path)
    stored = json.loads((tmp_path / "calibration.json").read_text())
    assert list(stored["figures"]["rows"]) == ["first"]
    assert stored["figures"]["rows"]["first"]["runs"] == 3
    with pytest.raises(InputError, match="never overwritten"):
        commands.calibration(out=tmp_path)
    with pytest.raises(InputError, match="seed"):
        commands.calibration(out=tmp_path, seed=1, resume=True)
    rows["second"] = measure("second")
    commands.calibration(out=tmp_path, resume=True)
    monkeypatch.setattr(calibration_study, "ROWS", {"zeroth": measure("zeroth")} | rows)
    commands.calibration(out=tmp_path, rows="zeroth", resume=True)
    assert measured == ["first", "second", "second", "zeroth"]
    stored = json.loads((tmp_path / "calibration.json").read_text())
    assert list(stored["figures"]["rows"]) == ["zeroth", "first", "second"]  # in the table's order


@pytest.mark.usefixtures("known_version")
def test_rows_of_another_version_or_file_are_not_continued(tmp_path: Path) -> None:
    setting = asdict(Setting())
    path = tmp_path / "calibration.json"
    assert finished(path, setting) == {}
    write_study(study_of({"one": a_row()}, setting, ()), tmp_path)
    assert finished(path, setting) == {"one": json.loads(json.dumps(a_row()))}
    with pytest.raises(InputError, match="split"):
        finished(path, setting | {"split": "test"})
    stored = json.loads(path.read_text())
    path.write_text(json.dumps(stored | {"version": "0.0.1"}))
    with pytest.raises(InputError, match="version"):
        finished(path, setting)
    row = stored["figures"]["rows"]["one"]
    for field, value in (("lost", -1), ("nees", {}), ("error_m", "far"), ("frames", 1e300)):
        path.write_text(json.dumps(stored | {"figures": {"rows": {"one": row | {field: value}}}}))
        with pytest.raises(InputError, match=f"rows.one.{field}"):
            finished(path, setting)
    path.write_text(json.dumps({"figures": {}}))
    with pytest.raises(InputError, match="outcome"):
        finished(path, setting)


@pytest.mark.slow
def test_the_smallest_row_from_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands.calibration(out=tmp_path, rows="dead-reckoning-low", runs=2)
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.startswith(".")) == [
        "calibration.html",
        "calibration.json",
        "calibration.svg",
        "study.json",
    ]
    row = json.loads((tmp_path / "calibration.json").read_text())["figures"]["rows"]["dead-reckoning-low"]
    assert (row["runs"], row["frames"], row["lost"], row["dimension"]) == (2, 198, 0, 3)
    assert row["segments"]["count"] == 8
    assert 0.05 < row["nees"]["mean"] < 10.0  # the robot knows its noise
    assert "dead-reckoning-low" in capsys.readouterr().out
