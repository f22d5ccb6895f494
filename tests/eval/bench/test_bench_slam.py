"""Test the results of ``bench slam``, with and without Open3D, on a short recording of a small apartment."""

import importlib
import os
import sys

import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.cli.bench import _show
from vssm_gym.cli.shared.console import literal_console
from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import load_sequence
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.bench import open3d_slam
from vssm_gym.eval.bench import slam as bench_slam

TABLE = furniture("table", (1.5, 2.0, 0.25), (0.6, 0.6, 0.5))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    save_scene(two_rooms(pieces=(TABLE,)), folder / "rooms.json")
    record_handheld(folder / "rooms.json", folder / "walk", metres=0.6, camera=CameraConfig(160, 120))
    return load_sequence(folder / "walk")


@pytest.fixture
def no_open3d(tmp_path, monkeypatch):
    """Put a package ``open3d`` that cannot be imported first on the path of the process."""
    (tmp_path / "open3d.py").write_text("raise ImportError('no such library')")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))


@pytest.mark.slow
def test_without_open3d_ours_is_reported_with_the_reason(sequence, no_open3d):
    heard = []
    result = bench_slam.compare(sequence, trials=2, on_progress=lambda *event: heard.append(event))
    (row,) = result["rows"]
    assert row["method"] == "vssm-gym"
    assert row["size"] == [160, 120]  # the recording is no larger
    assert 0.0 < row["stages_ms"]["step"]["p50"] <= row["stages_ms"]["step"]["p95"]
    assert list(row["stages_ms"])[:4] == ["step", "track", "map", "reference"]
    assert sum(row["stages_ms"][stage]["p50"] for stage in ("track", "map")) < row["stages_ms"]["step"]["p95"]
    assert 0.0 <= row["ate_m"] <= row["ate_max_m"] < 0.05
    assert row["astray"] == 0
    assert "pip install open3d" in result["missing"]
    assert "libusb-1.0-0 libgl1" in result["missing"]
    assert "\n" not in result["missing"]
    assert result["notices"] == []
    assert heard[-1] == ("vssm-gym", len(sequence.frames), len(sequence.frames))


def test_open3d_follows_a_slow_camera(sequence):
    """Run as its authors do, the comparison tracks a short noise-free walk in the same frame as ours."""
    try:
        importlib.import_module("open3d")
    except (ImportError, OSError):
        pytest.skip("Open3D cannot be imported here")
    (times, poses), failed, seconds = bench_slam._theirs(sequence, (160, 120), None)
    assert failed == 0
    np.testing.assert_allclose(poses[0], np.eye(4))
    assert bench_slam._errors(sequence, times, poses)["ate_m"] < 0.05
    assert set(seconds) == {"step", *open3d_slam.STAGES}
    np.testing.assert_allclose(seconds["step"], sum(seconds[stage] for stage in open3d_slam.STAGES))
    assert len(seconds["step"]) == len(times) - 1


def test_a_recording_that_is_too_small_is_refused(sequence, tmp_path):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    record_handheld(tmp_path / "rooms.json", tmp_path / "walk", metres=0.2, camera=CameraConfig(80, 60))
    with pytest.raises(InputError, match="at least 160x120, not 80x60"):
        bench_slam.compare(load_sequence(tmp_path / "walk"))


def test_errors_by_hand(sequence):
    """A trajectory moved as a whole has no error; one frame 30 cm off is astray; without truth there is no error."""
    poses = np.linalg.inv(sequence.true_poses()[0]) @ sequence.true_poses()
    clean = bench_slam._errors(sequence, sequence.times, poses)
    assert clean["ate_m"] < 1e-6
    assert clean["astray"] == 0
    poses[3, 0, 3] += 0.3
    assert bench_slam._errors(sequence, sequence.times, poses)["astray"] == 1
    nothing = {"ate_m": None, "ate_max_m": None, "astray": None}
    assert bench_slam._errors(sequence, sequence.times + 1e6, poses) == nothing


def test_a_stage_that_one_run_did_not_need_is_reported_of_the_others():
    """Its times, here of recovery, are those of the frames in which it ran."""
    runs = [{"step": np.array([0.010, 0.012])}, {"step": np.array([0.014]), "recover": np.array([0.002])}]
    row = bench_slam._row("vssm-gym", (160, 120), 0.07, runs, {"ate_m": None})
    assert row["stages_ms"]["step"]["p50"] == pytest.approx(12.0)
    assert row["stages_ms"]["recover"] == {"p50": pytest.approx(2.0), "p95": pytest.approx(2.0)}


def test_the_tracker_table_names_every_method(capsys):
    methods = {
        name: {"drives": 6, "rmse_m_median": 0.01 * k, "ms_a_step": 10.0 * k}
        for k, name in enumerate(("astar", "adam"), start=1)
    }
    result = {"scene": "oak", "trials": 9, "share_below_0.1m": 1.0, "rmse_m": {"0.5": 0.01}, "lost_steps": 0.0}
    _show("tracker", result | {"methods": methods}, literal_console(width=100))
    shown = capsys.readouterr().out
    assert "adam: RMSE median of 6 drives" in shown
    assert "2.00 cm, 20.0 ms" in shown
