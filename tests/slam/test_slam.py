"""Test ``vssm-gym slam`` on a room known in closed form, on real data, interrupted, and on bad input."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.helpers.slam_recordings import (
    CAMERA,
    FILES,
    FRAMES,
    GRID,
    ROOM,
    SIZE,
    names,
    poses_of,
    true_pose,
    write_sequence,
)
from vssm_gym.cli.slam import print_warnings
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.geometry.transforms import inverse, transform
from vssm_gym.inference.prism.filter import Prism
from vssm_gym.maps.voxel_map import VoxelMap, read_metadata
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.output import _content_hash
from vssm_gym.slam.run import run_slam
from vssm_gym.viz import stream


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("recording") / "room")


def test_a_recording_becomes_a_trajectory_a_map_and_a_report(vssm, recording, tmp_path):
    out = tmp_path / "new" / "out"
    code, printed, err = vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)
    assert code == 0, err
    assert names(out) == FILES
    assert printed.splitlines()[-1] == str(out / "report.html")

    times, poses = poses_of(out / "trajectory.txt")
    np.testing.assert_allclose(times, 1000.0 + 0.1 * np.arange(FRAMES), atol=1e-9)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
    expected = inverse(true_pose(0)) @ np.stack([true_pose(k) for k in range(FRAMES)])
    assert np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 0.02  # no alignment: the frame is given
    assert np.linalg.norm(expected[-1, :3, 3]) > 0.2

    voxel_map = VoxelMap.load(out / "map.npz")
    assert float(voxel_map.voxel_size) == pytest.approx(0.08)
    assert read_metadata(out / "map.npz")["frames"] == FRAMES

    vertices = np.asarray(trimesh.load(out / "mesh.ply", process=False).vertices)
    off = np.abs(ROOM.occupancy(transform(true_pose(0), vertices)))
    assert len(vertices) > 500
    assert np.median(off) < 0.1 * 0.08
    assert np.quantile(off, 0.95) < 0.5 * 0.08

    stats = json.loads((out / "stats.json").read_text())
    assert stats["frames"] == stats["frames_recorded"] == FRAMES
    assert stats["lost"] == []
    assert stats["config"]["size"] == SIZE
    assert stats["latency_ms"]["read"]["n"] == FRAMES
    latency = stats["latency_ms"]
    # The first frame, the first step and the first new reference view compile something.
    assert latency["whole step"]["n"] == FRAMES - len(stats["compiling_s"]) >= FRAMES - 3
    assert latency["track"]["n"] == latency["map"]["n"] == latency["whole step"]["n"]
    assert latency["track"]["p50"] + latency["map"]["p50"] <= 1.2 * latency["whole step"]["p50"]
    assert latency["whole step"]["p50"] <= latency["whole step"]["p95"] <= latency["whole step"]["max"]
    assert "recover" not in latency
    kept = stats["real_time"]
    assert kept["period_s"] == pytest.approx(0.1) and kept["frames"] == latency["whole step"]["n"]
    assert kept["factor"] > kept["factor_with_compiling"] > 0.0 and 0.0 <= kept["within_period"] <= 1.0
    assert f"{kept['factor']:.2f} x real time, {kept['within_period']:.0%} of the frames within" in printed
    assert stats["notices"] == stats["relocalised"] == []
    assert stats["calibration"] is None  # too few frames that have a true velocity
    assert stats["version"]

    # What it reports is what the command for it says of the file.
    code, table, _ = vssm("evaluate-trajectory", out / "trajectory.txt", recording / "groundtruth.txt")
    assert code == 0
    assert f"{FRAMES} pairs" in table
    assert f"{stats['errors']['ate_translation_se3']['rmse']:.6f}" in table

    page = (out / "report.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
    assert page.count('<img src="data:image/') == 8
    assert page.count("<script>") == page.count("script-src 'sha256-") == page.count("<canvas ") == 1
    assert len(page) < 5e6
    assert "No frame was lost" in page
    assert "Damaged input" not in page
    assert f"{100 * stats['errors']['ate_translation_se3']['rmse']:.2f} cm" in page

    # A finished run is never overwritten.
    before = (out / "trajectory.txt").read_bytes()
    code, _, err = vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)
    assert code == 2
    assert str(out) in err
    assert (out / "trajectory.txt").read_bytes() == before


@pytest.fixture(scope="module")
def learned(recording, tmp_path_factory) -> Path:
    """Return the posterior of a run over the recording."""
    run = run_slam(load_sequence(recording), SlamOptions(size=(80, 60), voxel=0.08, extent=6.4))
    path = tmp_path_factory.mktemp("learned") / "room.npz"
    run.posterior.save(path)
    return path


@pytest.mark.slow
def test_the_tracker_localises_a_camera_in_a_known_map(vssm, recording, learned, tmp_path):
    """The start is off by 15 cm and 5 degrees; the map is unchanged, and the outputs are those of PRISM."""
    start = "0.1,-0.1,0.05,0.02,0.0436,0,0.9988"
    options = ("--method", "tracker", "--map", learned, "--start", start)
    code, printed, err = vssm("slam", recording, "--out", tmp_path / "out", "--size", SIZE, *options)
    assert code == 0, err
    assert names(tmp_path / "out") == FILES and " 0 lost" in printed
    _, poses = poses_of(tmp_path / "out" / "trajectory.txt")
    expected = inverse(true_pose(0)) @ np.stack([true_pose(k) for k in range(FRAMES)])
    assert np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 0.02
    kept, given = VoxelMap.load(tmp_path / "out" / "map.npz"), VoxelMap.load(learned)
    np.testing.assert_array_equal(np.asarray(kept.occupancy), np.asarray(given.occupancy))
    np.testing.assert_array_equal(np.asarray(kept.occupancy_precision), np.asarray(given.occupancy_precision))
    stats = json.loads((tmp_path / "out" / "stats.json").read_text())
    assert stats["config"]["method"] == "tracker" and stats["config"]["map"] == learned.name
    assert stats["map"]["voxel"] == pytest.approx(0.08)


@pytest.mark.slow
def test_a_tracker_with_a_wrong_start_is_lost(vssm, recording, learned, tmp_path):
    """No pose beyond the map is accepted; recovery then tries the map's origin, where the camera is."""
    options = ("--method", "tracker", "--map", learned, "--start", "50,0,0,0,0,0,1")
    code, printed, err = vssm("slam", recording, "--out", tmp_path / "out", "--size", SIZE, *options)
    assert code == 0, err
    assert "1 lost, 1 relocalised" in printed
    stats = json.loads((tmp_path / "out" / "stats.json").read_text())
    assert [frame["index"] for frame in stats["lost"]] == [0]
    _, poses = poses_of(tmp_path / "out" / "trajectory.txt")
    expected = inverse(true_pose(0)) @ np.stack([true_pose(k) for k in range(FRAMES)])
    assert np.linalg.norm(poses[1:, :3, 3] - expected[1:, :3, 3], axis=1).max() < 0.02


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "tracker"], "map: expected a map file with method tracker"),
        (["--map", "{map}"], "map: expected a map file with method tracker, and none"),
        (["--start", "0,0,0,0,0,0,1"], "start: expected a pose in a map"),
        (["--method", "tracker", "--map", "{map}", "--start", "1,2"], "start: expected x,y,z,qx,qy,qz,qw"),
        (["--method", "tracker", "--map", "{map}", "--start", "a"], "start: expected numbers"),
        (["--method", "tracker", "--map", "{map}", "--imu"], "imu: expected False with method tracker"),
        (["--method", "tracker", "--map", "nowhere.npz"], "an existing map file"),
    ],
)
def test_bad_options_of_the_tracker_are_one_line(vssm, recording, learned, tmp_path, options, message):
    options_here = [word.format(map=learned) for word in options]
    code, _, err = vssm("slam", recording, "--out", tmp_path / "out", "--size", SIZE, *options_here)
    assert code == 2
    assert message in err and err.strip().count("\n") == 0
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_lost_frame_is_reported_and_does_not_change_the_map(vssm, tmp_path):
    """The recording has no ground truth: the report states that, and has no errors."""
    source = write_sequence(tmp_path / "room", strange=6)
    (source / "groundtruth.txt").unlink()
    code, printed, err = vssm("slam", source, "--out", tmp_path / "out", "--size", SIZE, *GRID)
    assert code == 0, err
    assert "1 lost" in printed
    assert "ATE" not in printed
    stats = json.loads((tmp_path / "out" / "stats.json").read_text())
    assert [frame["index"] for frame in stats["lost"]] == [6]
    assert stats["lost"][0]["status"].startswith("lost track")
    assert stats["errors"] is None

    _, poses = poses_of(tmp_path / "out" / "trajectory.txt")
    assert len(poses) == FRAMES
    expected = inverse(true_pose(0)) @ np.stack([true_pose(k) for k in range(FRAMES)])
    off = np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=1)
    assert np.delete(off, 6).max() < 0.02
    vertices = np.asarray(trimesh.load(tmp_path / "out" / "mesh.ply", process=False).vertices)
    behind = transform(true_pose(0), vertices)[:, 0] < -1.0  # what only the strange frame saw
    assert not behind.any()

    page = (tmp_path / "out" / "report.html").read_text()
    assert "1 of 10 frames were lost" in page
    assert "no ground truth" in page


def test_ctrl_c_keeps_the_finished_frames(vssm, recording, tmp_path, monkeypatch):
    out = tmp_path / "out"
    real, calls = Prism.step, []

    def interrupted(*arguments, **named):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(*arguments, **named)

    monkeypatch.setattr(Prism, "step", interrupted)
    code, _, err = vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)
    assert code == 130
    assert err.splitlines()[-1].startswith("interrupted")
    assert names(out) == ["slam.json", "trajectory.partial.txt"]
    assert len(poses_of(out / "trajectory.partial.txt")[0]) == 4

    # Another run leaves the poses alone. The same one may use the folder, and its partial file replaces the old one.
    code, _, err = vssm("slam", recording, "--out", out, "--size", SIZE, *GRID, "--rate", "5")
    assert (code, err.count("\n")) == (2, 1) and "another SLAM run belongs into another folder" in err
    assert len(poses_of(out / "trajectory.partial.txt")[0]) == 4
    calls.clear()
    calls.extend([1, 1])
    assert vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)[0] == 130
    assert len(poses_of(out / "trajectory.partial.txt")[0]) == 2


def test_the_folder_of_a_run_belongs_to_everything_that_it_reads(recording, tmp_path):
    """A copy of a recording may go on; one of the same name and stamps with other content may not."""
    copy = tmp_path / "elsewhere" / recording.name
    shutil.copytree(recording, copy)
    read = load_sequence(recording)
    assert _content_hash(load_sequence(copy)) == _content_hash(read)
    image = copy / "rgb" / read.frames[3].rgb.name
    image.write_bytes(image.read_bytes() + b"x")
    others = [
        load_sequence(copy),
        replace(read, depth_scale=read.depth_scale * 1.1),
        replace(read, T_body_cam=np.eye(4)),
        replace(read, truth=None),
        replace(read, camera=read.camera.resized(40, 30)),
        replace(read, frames=read.frames[:-1]),
    ]
    assert len({_content_hash(sequence) for sequence in [read, *others]}) == len(others) + 1


def test_the_readings_outside_a_small_grid_are_counted(recording):
    """For a cube that ends before the far wall, the depths give the exact proportion outside."""
    sequence = load_sequence(recording)
    small = replace(sequence, frames=sequence.frames[:1])
    run = run_slam(small, SlamOptions(size=(80, 60), voxel=0.08, extent=4.8))
    _, depth = FrameReader(small, (80, 60))[0]
    p_world = np.asarray(CAMERA.rays()) * depth[..., None]
    low, high = run.map.bounds  # whole blocks: a little more than what was asked for
    inside = ((p_world >= low) & (p_world <= high)).all(axis=-1)
    assert run.frames[0].in_grid == pytest.approx(inside[depth > 0.0].mean(), abs=0.05)  # it samples
    assert 0.1 < run.frames[0].in_grid < 0.9


@pytest.mark.slow
def test_the_viewer_is_shown_every_frame_and_the_surface(vssm, recording, tmp_path, monkeypatch):
    shown = []

    class Screen:
        def __init__(self, name, camera):
            shown.append((name, camera.width, camera.height))

        def frame(self, time, T_world_cam, rgb, depth, *, lost, step_ms):
            shown.append((time, rgb.shape, depth.shape, lost, step_ms > 0.0))

        def surface(self, mesh):
            shown.append(len(mesh.vertices) > 500)

        def close(self):
            shown.append("closed")

    monkeypatch.setattr(stream, "open_viewer", Screen)
    code, _, err = vssm("slam", recording, "--out", tmp_path / "out", "--size", SIZE, *GRID, "--viewer")
    assert code == 0, err
    assert shown[0] == ("room", 80, 60)
    assert [frame[1:] for frame in shown[1:-2]] == FRAMES * [((60, 80, 3), (60, 80), False, True)]
    assert shown[-2:] == [True, "closed"]


def test_without_rerun_the_viewer_is_refused_before_any_work(vssm, recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    code, _, err = vssm("slam", recording, "--out", tmp_path / "out", "--viewer")
    assert (code, err.count("\n")) == (2, 1)
    assert "'.[viz]'" in err
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--size", "160"), "size"),
        (("--size", "8x6"), "size"),
        (("--size", "axb"), "size"),
        (("--rate", "0"), "rate"),
        (("--rate", "nan"), "rate"),
        (("--voxel", "0"), "voxel"),
        (("--voxel", "nan"), "voxel"),
        (("--extent", "-3"), "extent"),
        (("--extent", "100", "--voxel", "0.02"), "cells"),
        (("--solver", "newton"), "gauss_newton, adam"),
        (("--samples", "0"), "samples"),
        (("--seed", "-1"), "seed"),
        (("--seed", "99999999999999999999"), "seed"),
        (("--samples", "2"), "odd"),
        (("--intrinsics", "500,500,320"), "intrinsics"),
        (("--intrinsics", "a,b,c,d"), "intrinsics"),
        (("--intrinsics", "0,500,320,240"), "intrinsics"),
        (("--intrinsics", "nan,500,320,240"), "intrinsics"),
    ],
)
def test_a_wrong_option_is_one_line_and_writes_nothing(vssm, recording, tmp_path, arguments, complaint):
    code, _, err = vssm("slam", recording, "--out", tmp_path / "out", *arguments)
    assert code == 2
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert complaint in err
    assert names(tmp_path) == []


def test_missing_folders_and_files_are_named(vssm, recording, tmp_path):
    out = tmp_path / "out"
    code, _, err = vssm("slam", tmp_path / "nowhere", "--out", out)
    assert (code, "nowhere" in err, err.count("\n")) == (2, True, 1)
    empty = tmp_path / "empty"
    empty.mkdir()
    code, _, err = vssm("slam", empty, "--out", out)
    assert (code, "rgb.txt" in err, err.count("\n")) == (2, True, 1)
    assert not out.exists()
    (tmp_path / "out").write_text("a file")
    code, _, err = vssm("slam", recording, "--out", out)
    assert (code, "folder" in err) == (2, True)
    assert out.read_text() == "a file"
    code, _, err = vssm("slam", recording, "--out", out / "below", "--size", SIZE, *GRID)
    assert (code, "folder" in err) == (2, True)


@pytest.mark.slow
def test_ground_truth_of_another_time_only_removes_the_errors(vssm, recording, tmp_path):
    """With ground truth of other times the map is made nevertheless, and the reason is reported."""
    source = tmp_path / "room"
    shutil.copytree(recording, source)
    truth = source / "groundtruth.txt"
    rows = [line.split() for line in truth.read_text().splitlines() if not line.startswith("#")]
    truth.write_text("".join(" ".join([str(float(row[0]) + 1e4), *row[1:]]) + "\n" for row in rows))
    code, printed, err = vssm("slam", source, "--out", tmp_path / "out", "--size", SIZE, *GRID)
    assert code == 0, err
    assert "errors against the ground truth cannot be computed" in printed
    assert names(tmp_path / "out") == FILES


@pytest.mark.slow
def test_readings_outside_the_map_give_a_warning(vssm, recording, tmp_path):
    """A depth scale five times too small puts the room's walls outside the cube."""
    source = tmp_path / "room"
    shutil.copytree(recording, source)
    stored = json.loads((source / "camera.json").read_text())
    (source / "camera.json").write_text(json.dumps(stored | {"depth_scale": stored["depth_scale"] / 5.0}))
    code, _, err = vssm("slam", source, "--out", tmp_path / "out", "--size", SIZE, *GRID)
    assert code == 0, err
    assert "depth readings lie outside the map's cube" in err and "depth scale" in err


def test_a_folder_with_other_content_is_refused(vssm, recording, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    code, _, err = vssm("slam", recording, "--out", tmp_path)
    assert code == 2
    assert str(tmp_path) in err
    assert names(tmp_path) == ["thesis.tex"]


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "result"), [("damaged", "10 frames, 1 lost"), ("missing", "9 frames, 0 lost")])
def test_a_bad_image_gives_a_warning_and_loses_one_frame(vssm, recording, tmp_path, fault, result):
    """A missing file is no frame; one that cannot be read is a frame without a reading."""
    source = tmp_path / "room"
    shutil.copytree(recording, source)
    bad = sorted((source / "depth").iterdir())[5]
    if fault == "missing":
        bad.unlink()
    else:
        bad.write_bytes(bad.read_bytes()[:40])
    out = tmp_path / "out"
    code, printed, err = vssm("slam", source, "--out", out, "--size", SIZE, *GRID)
    assert code == 0, err
    (warning,) = (line for line in err.splitlines() if line.startswith("warning: "))
    assert bad.name in warning
    assert result in printed
    stats = json.loads((out / "stats.json").read_text())
    assert [bad.name in notice for notice in stats["notices"]] == [True]
    lost = [(frame["index"], frame["status"][:8]) for frame in stats["lost"]]
    assert lost == ([(5, "no depth")] if fault == "damaged" else [])
    shown = (out / "report.html").read_text()
    assert "Damaged input" in shown
    assert bad.name in shown
    assert len(poses_of(out / "trajectory.txt")[0]) == stats["frames"]


def test_many_warnings_are_counted(capsys):
    print_warnings([f"image {i}" for i in range(12)])
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["warning: image 0", "warning: image 1"]
    assert lines[-1] == "warning: and 7 more like these"
    print_warnings([])
    assert capsys.readouterr().err == ""


def test_a_sequence_without_any_depth_is_refused(vssm, tmp_path):
    source = write_sequence(tmp_path / "room", blank=FRAMES)
    code, _, err = vssm("slam", source, "--out", tmp_path / "out", "--size", SIZE, *GRID)
    assert code == 2
    assert "depth" in err.splitlines()[-1]


def test_given_intrinsics_replace_those_of_the_folder(recording):
    """Intrinsics are those of the recorded images; at half the size they are halved about the images' edges."""
    sequence = load_sequence(recording, (60.0, 50.0, 30.0, 20.0, 0.1, 0.0, 0.0, 0.0, 0.0))
    reader = FrameReader(sequence, (40, 30))
    np.testing.assert_allclose(reader.camera.K, [[30.0, 0.0, 14.75], [0.0, 25.0, 9.75], [0.0, 0.0, 1.0]])
    assert sequence.distortion.tolist() == [0.1, 0.0, 0.0, 0.0, 0.0]
