"""Test the study of maps' surfaces: its errors, its table, how it is continued, and one map from end to end."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.analytic_room import box_distance
from tests.helpers.box_rooms import PLAIN
from vssm_gym.cli.studies import simulated as commands
from vssm_gym.envs.scenes.solids import SolidBox, signed_distance
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import page, stored_rows
from vssm_gym.eval.studies.map_reliability import study as reliability_study
from vssm_gym.eval.studies.map_reliability.study import Row, Setting, finished
from vssm_gym.eval.studies.map_reliability.surface_errors import POINTS, SurfaceErrors, measure
from vssm_gym.eval.studies.map_reliability.table import HEADER, lines_of, study_of, summarise
from vssm_gym.eval.studies.page import write_study


def drawn(scale: float = 1.0, n: int = 4000) -> SurfaceErrors:
    """Return errors of ``scale`` stds, with stds of 1 to 30 mm."""
    rng = np.random.default_rng(0)
    std = np.exp(rng.uniform(np.log(0.001), np.log(0.03), n))
    return SurfaceErrors(scale * std * rng.normal(size=n), std)


def test_right_stds_give_a_ratio_of_one_in_every_bin() -> None:
    row = summarise({"a": drawn(), "b": drawn()})
    assert [one["points"] > 0 for one in row["bins"]] == [True] * 5
    assert sum(one["points"] for one in row["bins"]) == row["whole"]["points"] == 8000
    for one in row["bins"]:
        assert one["low_m"] <= one["std_m"] < one["high_m"]
        assert one["error_m"] / one["std_m"] == pytest.approx(1.0, abs=0.1)
        assert one["inside"] == pytest.approx(0.95, abs=0.03)


def test_stds_that_are_half_as_large_give_two() -> None:
    row = summarise({"a": drawn(2.0)})
    assert row["whole"]["error_m"] / row["whole"]["std_m"] == pytest.approx(2.0, rel=0.05)
    assert row["whole"]["inside"] == pytest.approx(0.673, abs=0.03)  # of a normal within 0.98 stds


def test_the_table_has_a_line_for_each_bin() -> None:
    rows = {"exact": summarise({"a": drawn(), "b": drawn(2.0)})}
    study = study_of(rows, {"split": "train"})
    assert all(len(line) == len(HEADER) for line in study.lines)
    assert [line[1] for line in study.lines] == ["all", "0 to 2", "2 to 4", "4 to 8", "8 to 16", "16 to 32"]
    assert "exact 1.5" in study.answer
    assert lines_of("exact", rows["exact"])[0][0] == "exact: 2"
    assert ET.fromstring(study.picture) is not None
    json.dumps(study.figures, allow_nan=False)


def test_distances_are_signed_and_those_of_a_turned_box() -> None:
    """Against the closed form in the frame of the box; of two boxes the nearer one counts."""
    box = SolidBox("box", "wall", (0.4, -0.2, 0.5), (1.0, 0.6, 1.0), 0.7, PLAIN)
    p = np.random.default_rng(0).uniform(-2.0, 2.0, (200, 3))
    c, s = np.cos(0.7), np.sin(0.7)
    local = (p - np.array(box.center)) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    expected = box_distance(local, ((-0.5, -0.3, -0.5), (0.5, 0.3, 0.5)))
    np.testing.assert_allclose(signed_distance(p, [box]), expected, atol=1e-12)
    assert (signed_distance(p, [box]) < 0.0).any()
    other = SolidBox("other", "wall", (-1.0, 1.0, 0.0), (0.2, 0.2, 0.2), 0.0, PLAIN)
    both = np.minimum(signed_distance(p, [box]), signed_distance(p, [other]))
    np.testing.assert_array_equal(signed_distance(p, [box, other]), both)
    near = signed_distance(p, [box, other], within=0.3)
    np.testing.assert_array_equal(np.minimum(near, 0.3), np.minimum(both, 0.3))


@pytest.mark.parametrize("change", [{"maps": 0}, {"seed": -1}, {"voxel": 0.001}, {"split": "all"}])
def test_a_bad_option_writes_nothing(tmp_path: Path, change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        commands.map_reliability(out=tmp_path / "out", **change)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def known_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the version: asking git for it takes longer than the rest."""
    for module in (page, stored_rows):
        monkeypatch.setattr(module, "package_version", lambda: "1.0")


@pytest.mark.usefixtures("known_version")
def test_an_interrupted_study_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def made(scene: str, **options: object) -> SurfaceErrors:
        asked.append(f"{scene} {options['sensor_noise']}")
        if len(asked) == 3:
            raise KeyboardInterrupt
        return drawn()

    monkeypatch.setattr(reliability_study, "measure", made)
    monkeypatch.setattr(reliability_study, "ROWS", {"a": Row("recorded", "none"), "b": Row("recorded", "kinect")})
    with pytest.raises(KeyboardInterrupt, match=r"map-reliability\.json"):
        commands.map_reliability(out=tmp_path, maps=2)
    with pytest.raises(InputError, match="voxel"):
        commands.map_reliability(out=tmp_path, maps=2, voxel=0.07, resume=True)
    commands.map_reliability(out=tmp_path, maps=2, resume=True)
    assert asked == ["fern none", "ivy none", "fern kinect", "fern kinect", "ivy kinect"]
    stored = json.loads((tmp_path / "map-reliability.json").read_text())
    assert list(stored["figures"]["rows"]) == ["a", "b"]


@pytest.mark.usefixtures("known_version")
def test_an_outcome_of_another_study_is_refused(tmp_path: Path) -> None:
    path, rows = tmp_path / "map-reliability.json", {"true poses, Kinect": summarise({"a": drawn()})}
    assert finished(path, Setting()) == {}
    write_study(study_of(rows, {"split": "train", "seed": 0, "maps": None, "voxel": 0.05}), tmp_path)
    assert finished(path, Setting()) == json.loads(json.dumps(rows))
    with pytest.raises(InputError, match="split"):
        finished(path, Setting(split="test"))
    for damaged in ({}, {"setting": {}, "figures": {"rows": {"another": {}}}}, []):
        path.write_text(json.dumps(damaged))
        with pytest.raises(InputError):
            finished(path, Setting())


@pytest.mark.slow
def test_a_map_of_an_apartment_is_as_right_as_it_states() -> None:
    """At true poses: rms error within a third of the rms stated std, nine points of ten and more inside 95 %."""
    found = measure("fern", poses="recorded", sensor_noise="none", voxel=0.07, seed=3)
    row = summarise({"fern": found})["whole"]
    assert 0.9 * POINTS < row["points"] <= POINTS
    assert 0.67 < row["error_m"] / row["std_m"] < 1.33
    assert row["inside"] > 0.9
