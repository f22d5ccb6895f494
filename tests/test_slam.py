"""``vssm-gym slam`` on a recording of a room known in closed form, on real data, interrupted, and on bad input."""

import json
import re
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from analytic_room import Room, camera_pose
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.block_table import BlockTable
from vssm_gym.camera import Camera
from vssm_gym.cli import main as main_module
from vssm_gym.cli.slam import print_warnings
from vssm_gym.data.sequences import FrameReader, SequenceWriter, load_sequence
from vssm_gym.data.trajectories import read_trajectory, velocities
from vssm_gym.errors import InputError
from vssm_gym.eval import slam_output, slam_report, slam_run, slam_states, trajectory
from vssm_gym.eval.slam_figures import _belief, _cells
from vssm_gym.eval.slam_run import SlamOptions, SlamRun, TrackedFrame, prefetch, run_slam, thin
from vssm_gym.geometry import R_BODY_CAM, inverse, se3_exp, transform
from vssm_gym.inference import prism
from vssm_gym.inference.map_update import update
from vssm_gym.inference.tracking import observe
from vssm_gym.viz import stream
from vssm_gym.viz.mesh import surface_mesh
from vssm_gym.voxel_map import OBSERVED_PRECISION, VoxelMap, read_metadata

FRAMES = 10
SIZE = "80x60"  # one size and one grid everywhere: each compiles the step anew
GRID = ("--voxel", "0.08", "--extent", "6.4")
CAMERA = Camera.from_hfov(80, 60, np.radians(70.0))
ROOM = Room(((-2.0, -1.6, 0.0), (2.2, 1.7, 2.3)), (((0.9, -0.4, 0.0), (1.4, 0.5, 0.8)),))
FILES = ["map.npz", "mesh.ply", "report.html", "stats.json", "trajectory.txt"]


def true_pose(k: int) -> np.ndarray:
    """A hand that moves 2 to 3 cm and about a degree a frame."""
    place = (-0.8 + 0.025 * k, 0.2 * np.sin(0.25 * k), 1.1 + 0.05 * np.sin(0.4 * k))
    return camera_pose(place, 0.02 * k - 0.1, 0.2 + 0.01 * k, 0.01 * k)


def image_from(T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RGB uint8 and z-depth (m)."""
    image = ROOM.image(T_world_cam, CAMERA)
    return np.rint(255.0 * np.asarray(image.rgb)).astype(np.uint8), np.asarray(image.depth)


def frame_of(k: int) -> tuple[np.ndarray, np.ndarray]:
    return image_from(true_pose(k))


def write_sequence(
    folder: Path, strange: int | None = None, blank: int = 0, first: tuple[np.ndarray, np.ndarray] | None = None
) -> Path:
    """A TUM folder of the room; frame ``strange`` looks the other way, the first ``blank`` frames have no depth.

    ``first`` takes the place of the first image.
    """
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3] = R_BODY_CAM
    writer = SequenceWriter(folder, CAMERA, T_body_cam)
    for k in range(FRAMES):
        rgb, depth = frame_of(k) if k != strange else image_from(camera_pose((0.3, 0.0, 1.2), 2.8, 0.4))
        rgb, depth = (rgb, depth) if first is None or k else first
        writer.append(1000.0 + 0.1 * k, rgb, depth * (k >= blank), true_pose(k), np.zeros(0))
    writer.close()
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("recording") / "room")


@pytest.fixture
def vssm(monkeypatch, capsys):
    """Runs the console script in this process: ``vssm("slam", ...) -> (exit code, stdout, stderr)``."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vssm-gym", *map(str, arguments)])
        try:
            code = main_module.main()
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def poses_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and poses, and that the file has a line for each."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    times, poses = read_trajectory(path)
    assert len(lines) == len(times)
    return times, poses


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# The whole command


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
    # The first frame, the first step and the first new anchor compile something.
    assert latency["whole step"]["n"] == FRAMES - len(stats["compiling_s"]) >= FRAMES - 3
    assert latency["track"]["n"] == latency["map"]["n"] == latency["whole step"]["n"]
    assert latency["track"]["p50"] + latency["map"]["p50"] <= 1.2 * latency["whole step"]["p50"]
    assert latency["whole step"]["p50"] <= latency["whole step"]["p95"] <= latency["whole step"]["max"]
    assert "recover" not in latency
    assert stats["notices"] == stats["found_again"] == []
    assert stats["calibration"] is None  # too few frames that have a true velocity
    assert stats["version"]

    # What it reports is what the command for it says of the file.
    code, table, _ = vssm("evaluate-trajectory", out / "trajectory.txt", recording / "groundtruth.txt")
    assert code == 0
    assert f"{FRAMES} pairs" in table
    assert f"{stats['errors']['ate_translation_se3']['rmse']:.6f}" in table

    page = (out / "report.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert page.count("<img src='data:image/") == 7
    assert "No frame was lost" in page
    assert "Damaged input" not in page
    assert f"{100 * stats['errors']['ate_translation_se3']['rmse']:.2f} cm" in page

    # A finished run is never overwritten.
    before = (out / "trajectory.txt").read_bytes()
    code, _, err = vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)
    assert code == 2
    assert str(out) in err
    assert (out / "trajectory.txt").read_bytes() == before


def test_a_lost_frame_is_said_to_be_lost_and_leaves_the_map_alone(vssm, tmp_path):
    """Without ground truth: the report says that too, and nothing is measured against it."""
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
    real, calls = prism.step, []

    def interrupted(*arguments, **named):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(*arguments, **named)

    monkeypatch.setattr(slam_run.prism, "step", interrupted)
    code, _, err = vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)
    assert code == 130
    assert err.splitlines()[-1].startswith("interrupted")
    assert names(out) == ["trajectory.partial.txt"]
    assert len(poses_of(out / "trajectory.partial.txt")[0]) == 4

    # Another run may use the folder, and its own partial file replaces the old one.
    calls.clear()
    calls.extend([1, 1])
    assert vssm("slam", recording, "--out", out, "--size", SIZE, *GRID)[0] == 130
    assert len(poses_of(out / "trajectory.partial.txt")[0]) == 2


# The loop


def options(**changes) -> SlamOptions:
    return SlamOptions(size=(80, 60), voxel=0.08, extent=6.4, **changes)


def test_the_map_starts_at_the_first_depth(tmp_path):
    run = run_slam(load_sequence(write_sequence(tmp_path / "room", blank=2)), options())
    assert run.lost.tolist() == [True, True] + [False] * (FRAMES - 2)
    np.testing.assert_array_equal(run.poses[:3], np.tile(np.eye(4), (3, 1, 1)))
    expected = inverse(true_pose(2)) @ true_pose(FRAMES - 1)
    assert np.linalg.norm(run.poses[-1, :3, 3] - expected[:3, 3]) < 0.02


@pytest.mark.parametrize("first", ["a strip", "another place"])
def test_a_map_that_starts_from_a_bad_image_starts_anew(tmp_path, first):
    """Nothing fits it: after three readable frames the map starts again, and that is said."""
    rgb, depth = frame_of(0)
    bad = {
        "a strip": (rgb, depth * (np.arange(80) < 8)),
        "another place": image_from(camera_pose((0.2, 0.3, 1.2), 2.7, 0.4)),
    }[first]
    run = run_slam(load_sequence(write_sequence(tmp_path / "room", first=bad)), options())
    assert run.lost.tolist() == [True] * 4 + [False] * (FRAMES - 4)
    assert any("starts anew at frame 4" in notice for notice in run.notices)
    expected = inverse(true_pose(4)) @ true_pose(FRAMES - 1)
    assert np.linalg.norm(run.poses[-1, :3, 3] - expected[:3, 3]) < 0.02


def test_a_black_first_image_with_depth_is_tracked_by_its_shapes(tmp_path):
    rgb, depth = frame_of(0)
    run = run_slam(load_sequence(write_sequence(tmp_path / "room", first=(0 * rgb, depth))), options())
    assert not run.lost.any()
    expected = inverse(true_pose(0)) @ true_pose(FRAMES - 1)
    assert np.linalg.norm(run.poses[-1, :3, 3] - expected[:3, 3]) < 0.03


def test_the_readings_outside_a_small_grid_are_counted(recording):
    """A cube that ends before the far wall: what it cannot hold is known exactly from the depths."""
    sequence = load_sequence(recording)
    small = replace(sequence, frames=sequence.frames[:1])
    run = run_slam(small, SlamOptions(size=(80, 60), voxel=0.08, extent=4.8))
    _, depth = FrameReader(small, (80, 60))[0]
    p_world = np.asarray(CAMERA.rays()) * depth[..., None]
    low, high = run.map.bounds  # whole blocks: a little more than what was asked for
    inside = ((p_world >= low) & (p_world <= high)).all(axis=-1)
    assert run.frames[0].in_grid == pytest.approx(inside[depth > 0.0].mean(), abs=0.05)  # it samples
    assert 0.1 < run.frames[0].in_grid < 0.9


def test_real_images_are_tracked(shared_data):
    """The first 12 frames of TUM fr1_xyz: the camera moves 20 cm."""
    sequence = load_sequence(shared_data / "tum_fr1_xyz")
    run = run_slam(replace(sequence, frames=sequence.frames[:12]), options())
    assert not run.lost.any()
    result = trajectory.evaluate(run.times, run.poses, *sequence.truth)
    assert result["ate_translation_se3"]["rmse"] < 0.02


@pytest.mark.slow
def test_the_whole_real_sequence_at_the_default_settings(shared_data):
    sequence = load_sequence(shared_data / "tum_fr1_xyz")
    run = run_slam(sequence, SlamOptions())
    result = trajectory.evaluate(run.times, run.poses, *sequence.truth)
    assert len(run.frames) == 266
    assert result["ate_translation_se3"]["rmse"] < 0.03
    assert run.lost.mean() < 0.05


# The states of a run and what the report says of them


STD = np.array([0.003, 0.004, 0.005, 0.002, 0.003, 0.004, 0.05, 0.06, 0.07, 0.1, 0.2, 0.3])


def made_up_run(sequence, frames: int, seed: int = 0, **changes) -> SlamRun:
    """Frames that err just as their covariance says, fields of some changed (``at_3={...}``)."""
    rng = np.random.default_rng(seed)
    times, truth = sequence.truth
    start = inverse(truth[0])
    v = velocities(times, start @ truth)
    made = []
    for k in range(frames):
        error = STD * rng.standard_normal(12) * (k > 0)  # the first frame is the world
        T = np.asarray(start @ truth[k] @ np.asarray(se3_exp(jnp.asarray(error[:6]))), float)
        frame = TrackedFrame(
            index=k, time=times[k], T_world_cam=T, status=prism.OK, inlier_share=0.9, coverage=0.9, photometric=2.0,
            in_grid=1.0, read_s=0.01, wait_s=0.0, step_s=0.02, stages={"track": 0.012, "map": 0.004}, warm=k > 0,
            velocity=None if k == 0 else v[k - 1] + error[6:], covariance=None if k == 0 else np.diag(STD**2),
            left_window=0,
        )  # fmt: skip
        made.append(replace(frame, **changes.get(f"at_{k}", {})))
    m = VoxelMap.cube((0.0, 0.0, 0.0), 6.4, 0.08)
    return SlamRun(tuple(made), m, FrameReader(sequence, (80, 60)), ())


@pytest.fixture(scope="module")
def long_sequence(tmp_path_factory):
    """300 true poses that turn and move in all directions; only the first image exists, and only it is looked at."""
    folder = write_sequence(tmp_path_factory.mktemp("long") / "room")
    sequence = load_sequence(folder)
    times = 1000.0 + 0.1 * np.arange(300)
    poses = np.stack([true_pose(k) for k in range(300)])
    return replace(sequence, truth=(times, poses))


def test_a_filter_that_errs_as_it_says_is_calibrated(long_sequence):
    """In the camera's tangent and in the world: an error of order, frame or side would show in the NEES at once."""
    run = made_up_run(long_sequence, 300)
    truth = slam_states.Truth.of(run, long_sequence)
    summary = slam_states.calibration_summary(run, truth)
    assert summary["pose"]["nees"] == pytest.approx(6.0, abs=0.7)
    assert summary["velocity"]["nees"] == pytest.approx(6.0, abs=0.7)
    assert min(summary["velocity"]["share_in_band"]) > 0.9
    # Told a third of the std, it is nine times too sure.
    sure = replace(
        run, frames=tuple(replace(f, covariance=None if f.covariance is None else f.covariance / 9) for f in run.frames)
    )
    assert slam_states.calibration_summary(sure, truth)["pose"]["nees"] == pytest.approx(9 * summary["pose"]["nees"])


def test_the_calibration_does_not_depend_on_the_frame_of_the_truth(long_sequence):
    run = made_up_run(long_sequence, 60)
    times, poses = long_sequence.truth
    moved = replace(long_sequence, truth=(times, camera_pose((3.0, -2.0, 1.0), 2.0, 0.7) @ poses))
    summaries = [slam_states.calibration_summary(run, slam_states.Truth.of(run, s)) for s in (long_sequence, moved)]
    for state in ("pose", "velocity"):
        assert summaries[0][state]["nees"] == pytest.approx(summaries[1][state]["nees"], rel=1e-6)


def test_lost_frames_have_no_velocity_and_are_no_part_of_the_calibration(long_sequence):
    lost = {"status": prism.LOST, "covariance": np.eye(12), "velocity": np.zeros(6), "photometric": np.nan}
    run = made_up_run(long_sequence, 40, at_7=lost)
    truth = slam_states.Truth.of(run, long_sequence)
    mean, std = slam_states.velocity_bands(run)
    assert np.isnan(mean[[0, 7]]).all()
    assert np.isfinite(np.delete(mean, [0, 7], axis=0)).all()
    assert np.isfinite(np.delete(std, [0, 7], axis=0)).all()
    assert slam_states.calibrations(run, truth)["velocity"].whitened.shape == (38, 6)


def test_every_status_is_said(long_sequence):
    """A lost frame, one without depth, one found again, a grid that moved, a warning; and a map that holds nothing."""
    run = made_up_run(
        long_sequence,
        10,
        at_3={"status": prism.LOST, "photometric": np.nan, "stages": {"track": 0.01, "recover": 0.3}},
        at_4={"status": prism.NO_READING, "inlier_share": np.nan},
        at_5={"status": prism.RECOVERED, "left_window": 12, "stages": {"track": 0.01, "recover": 0.2}},
    )
    run = replace(run, notices=("rgb.txt: odd",))
    truth = slam_states.Truth.of(run, long_sequence)
    stats = slam_output.summarise(run, long_sequence, options(), 1.0, truth)
    assert json.loads(json.dumps(stats, allow_nan=False)) == stats
    assert [(frame["index"], frame["status"]) for frame in stats["lost"]] == [
        (3, prism.STATUS[prism.LOST]),
        (4, prism.STATUS[prism.NO_READING]),
    ]
    assert [frame["index"] for frame in stats["found_again"]] == [5]
    assert stats["map"]["blocks_forgotten"] == 12
    assert stats["map"]["storage"] == "dense"
    assert stats["latency_ms"]["recover"]["n"] == 2
    assert stats["notices"] == ["rgb.txt: odd"]
    stats["map"] |= {"vertices": 0, "faces": 0}
    shown = slam_report.page(run, long_sequence, truth, surface_mesh(run.map), stats, options().prism)
    for text in ("2 of 10 frames were lost", "found again 1 time", "12 observed blocks", "1 warning.", "rgb.txt: odd"):
        assert text in shown
    for status in (prism.LOST, prism.NO_READING, prism.RECOVERED):
        assert prism.STATUS[status] in shown


def stored_sparsely(m: VoxelMap, slots: int) -> VoxelMap:
    """The same belief with rows for the observed blocks only, last ones first."""
    stored = np.flatnonzero((np.asarray(m.occupancy_precision) > OBSERVED_PRECISION).any(axis=1))[::-1]
    assert len(stored) < slots
    sparse = VoxelMap.prior(m.origin, float(m.voxel_size), m.shape, slots=slots)
    arrays = ("occupancy", "occupancy_precision", "colour", "colour_precision")
    rows = [getattr(sparse, name).at[1 : 1 + len(stored)].set(getattr(m, name)[stored]) for name in arrays]
    table = BlockTable.of(m.blocks, slots, stored)
    return eqx.tree_at(lambda s: (*(getattr(s, name) for name in arrays), s.table), sparse, (*rows, table))


def test_slices_read_a_sparse_map_as_a_dense_one():
    """Where cells are and which points are known: by storage row, without laying out the cube."""
    image, config = observe(*frame_of(0)), options().prism.update
    dense = update(options().prior(), image.depth, image.rgb, jnp.eye(4), CAMERA, config)
    sparse = stored_sparsely(dense, 900)
    for below in (np.inf, -0.1):
        a, b = (np.array(sorted(map(tuple, _cells(m, below)))) for m in (dense, sparse))
        assert len(a) > 500
        np.testing.assert_allclose(a, b, atol=1e-6)
        at_cells = np.asarray(dense.occupancy_at(jnp.asarray(a, jnp.float32)))
        assert at_cells.max() < below + 1e-4
        assert (np.asarray(dense.precision(jnp.asarray(a, jnp.float32)))[:, 0] > 0.9).all()
    p = np.random.default_rng(0).uniform(-3.0, 3.0, (4000, 3))
    (mean, std), (sparse_mean, sparse_std) = _belief(dense, p), _belief(sparse, p)
    np.testing.assert_allclose(mean, sparse_mean, atol=1e-6)
    np.testing.assert_allclose(std, sparse_std, atol=1e-6)
    assert 0 < np.isfinite(mean).sum() < len(p)
    assert np.nanmax(std) <= 1.0


def test_storage_that_ran_out_is_said(long_sequence):
    run = made_up_run(long_sequence, 2)
    full = eqx.tree_at(lambda m: m.table.refused, stored_sparsely(run.map, 8), jnp.int32(5))
    assert slam_output.notices(run) == ()
    (notice,) = slam_output.notices(replace(run, map=full))
    assert notice.startswith("the map's storage is full: 5 ")


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
    assert "vssm-gym[viz]" in err
    assert names(tmp_path) == []


# Thinning and reading ahead


@given(
    gaps=st.lists(st.floats(0.001, 0.5), min_size=1, max_size=60),
    rate=st.floats(0.5, 40.0),
)
def test_thinning_holds_its_rate_over_every_stretch(gaps, rate):
    times = 1.3e9 + np.cumsum(gaps)
    kept = thin(times, rate)
    assert kept[0] == 0
    assert kept == sorted(set(kept))
    stamps = times[kept]
    for i in range(len(stamps)):
        counts = np.arange(1, len(stamps) - i + 1)
        assert (counts <= (stamps[i:] - stamps[i]) * rate + 1.5 + 1e-4).all()
    # And it leaves out no more than it must: where frames are missing, the period holds a frame.
    longest = max([*gaps, 0.0])
    assert (np.diff(stamps) <= 1.5 / rate + longest + 1e-6).all()


@given(st.lists(st.floats(-0.024, 0.024), min_size=2, max_size=80))
def test_a_jittering_camera_at_the_rate_keeps_every_frame(jitter):
    times = 1.3e9 + 0.1 * np.arange(len(jitter)) + np.array(jitter)
    assert thin(times, 10.0) == list(range(len(jitter)))


def test_a_third_of_a_fast_camera_is_a_third():
    times = np.arange(300) / 30.0
    kept = thin(times, 10.0)
    assert len(kept) == pytest.approx(100, abs=1)
    assert set(np.diff(kept)[2:]) == {3}


class SlowReader:
    """Gives each frame its number, late ones first; fails at ``broken``."""

    def __init__(self, broken: int | None = None) -> None:
        self.broken, self.asked = broken, []

    def __getitem__(self, index):
        self.asked.append(index)
        if index == self.broken:
            raise InputError("image.png", "pixels", "a readable image")
        time.sleep(0.002 * (index % 3))
        return np.full((1, 1, 3), index), np.full((1, 1), index)


def test_images_arrive_in_order_and_a_bad_one_raises_in_its_turn():
    images = prefetch(SlowReader(), [3, 1, 4, 1, 5, 9, 2, 6])
    assert [int(depth[0, 0]) for _, depth, _ in images] == [3, 1, 4, 1, 5, 9, 2, 6]
    images = prefetch(SlowReader(broken=5), [3, 1, 4, 1, 5, 9])
    assert [next(images)[1][0, 0] for _ in range(4)] == [3, 1, 4, 1]
    with pytest.raises(InputError):
        next(images)


def test_reading_stops_when_nobody_asks():
    reader = SlowReader()
    images = prefetch(reader, list(range(100)))
    next(images)
    images.close()
    read = len(reader.asked)
    assert read <= slam_run.AHEAD + 1
    time.sleep(0.05)
    assert len(reader.asked) == read


# Bad input


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


def test_a_truth_of_another_time_costs_nothing_but_the_errors(vssm, recording, tmp_path):
    """Its stamps lie elsewhere: the map is made all the same, and the reason is said."""
    source = tmp_path / "room"
    shutil.copytree(recording, source)
    truth = source / "groundtruth.txt"
    rows = [line.split() for line in truth.read_text().splitlines() if not line.startswith("#")]
    truth.write_text("".join(" ".join([str(float(row[0]) + 1e4), *row[1:]]) + "\n" for row in rows))
    code, printed, err = vssm("slam", source, "--out", tmp_path / "out", "--size", SIZE, *GRID)
    assert code == 0, err
    assert "errors against the ground truth cannot be computed" in printed
    assert names(tmp_path / "out") == FILES


def test_readings_beyond_the_map_are_warned_of(vssm, recording, tmp_path):
    """A depth scale five times too small puts the room's walls outside the cube."""
    source = tmp_path / "room"
    shutil.copytree(recording, source)
    stored = json.loads((source / "camera.json").read_text())
    (source / "camera.json").write_text(json.dumps(stored | {"depth_scale": stored["depth_scale"] / 5.0}))
    code, _, err = vssm("slam", source, "--out", tmp_path / "out", "--size", SIZE, *GRID)
    assert code == 0, err
    assert "depth readings lie outside the map's cube" in err and "depth scale" in err


def test_a_folder_with_other_content_is_left_alone(vssm, recording, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    code, _, err = vssm("slam", recording, "--out", tmp_path)
    assert code == 2
    assert str(tmp_path) in err
    assert names(tmp_path) == ["thesis.tex"]


@pytest.mark.parametrize(("fault", "result"), [("damaged", "10 frames, 1 lost"), ("missing", "9 frames, 0 lost")])
def test_a_bad_image_is_warned_of_and_costs_one_frame(vssm, recording, tmp_path, fault, result):
    """A file that is not there is no frame; one that cannot be read is a frame without a reading."""
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
    """They are of the recorded images; at half the size they are half, about the images' edges."""
    sequence = load_sequence(recording, (60.0, 50.0, 30.0, 20.0, 0.1, 0.0, 0.0, 0.0, 0.0))
    reader = FrameReader(sequence, (40, 30))
    np.testing.assert_allclose(reader.camera.K, [[30.0, 0.0, 14.75], [0.0, 25.0, 9.75], [0.0, 0.0, 1.0]])
    assert sequence.distortion.tolist() == [0.1, 0.0, 0.0, 0.0, 0.0]
