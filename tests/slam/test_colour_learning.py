"""Test ``vssm-gym slam --learn-camera``: the calibration gets better, is written, and what is not told is said."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.slam_recordings import FILES, SIZE, names, write_sequence
from tests.inference.smoothing.colour_room import STATED, TRUE, write_unregistered
from vssm_gym.cli.slam import slam as command
from vssm_gym.data.intrinsics import ColourCalibration
from vssm_gym.data.sequences import load_sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.colour_camera import PRIOR_STD
from vssm_gym.slam.colour_learning import LearnedColour
from vssm_gym.slam.options import SlamOptions


def slam(folder: Path, out: Path) -> None:
    command(folder, out, size=SIZE, voxel=0.08, extent=6.4, learn_camera=True)


def test_numbers_that_stay_near_the_prior_are_not_told() -> None:
    std = PRIOR_STD * np.array([0.1] * 5 + [0.6] + [0.1] * 4)
    learned = LearnedColour(ColourCalibration(STATED), ColourCalibration(TRUE, std=std), 2, True, 1.0)
    rows = {row.name: row for row in learned.parameters}
    assert [name for name, row in rows.items() if not row.told] == ["rotation z"]
    assert abs(rows["translation x"].learned - 25.0) < 0.1  # mm
    assert rows["translation x"].std == pytest.approx(5.0)
    assert rows["fx"].stated == 64.0
    assert rows["fx"].learned == pytest.approx(64.0 * np.exp(0.02), rel=1e-6)
    assert rows["fx"].std == pytest.approx(64.0 * np.exp(0.02) * 0.005)


def test_colour_that_is_registered_cannot_be_learned(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "room")
    with pytest.raises(InputError, match=r"learn-camera: expected a recording with the field colour in camera\.json"):
        slam(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_given_map_excludes_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="learn-camera"):
        SlamOptions(method="tracker", map=tmp_path / "map.npz", learn_camera=True)


@pytest.mark.slow
def test_the_command_learns_writes_and_shows_the_calibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = write_unregistered(tmp_path / "room"), tmp_path / "out"
    slam(folder, out)
    assert names(out) == sorted([*FILES, "camera.json"])
    printed = capsys.readouterr().out
    assert "translation x, mm" in printed
    stats = json.loads((out / "stats.json").read_text())
    assert not stats["lost"]
    rows = {row["name"]: row for row in stats["colour_camera"]["parameters"]}
    assert abs(rows["translation x"]["learned"] - 25.0) < 4.0
    assert abs(rows["fx"]["learned"] / 64.0 - np.exp(0.02)) < 0.006
    report = (out / "report.html").read_text()
    assert 'id="colour"' in report
    # What was written is a calibration of the recording, with the posterior as the prior of the next run.
    (folder / "camera.json").write_bytes((out / "camera.json").read_bytes())
    known = load_sequence(folder).colour
    assert known is not None
    before, after = STATED.difference(TRUE), known.view.difference(TRUE)
    assert np.linalg.norm(after[:3]) < 0.2 * np.linalg.norm(before[:3])
    assert (known.std < PRIOR_STD).all()
