"""Test the states of a run in the report: calibration, statuses, slices of the map."""

import json
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.slam_recordings import (
    CAMERA,
    frame_of,
    options,
    true_pose,
    write_sequence,
)
from tests.viz.hostile_text import KINDS, MARKUP, changed, check_page, harmless, suffix
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.data.trajectories import velocities
from vssm_gym.geometry.transforms import inverse, se3_exp
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.inference.status import Status
from vssm_gym.maps.block_table import BlockTable
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RigidState, rigid_belief
from vssm_gym.slam import output as slam_output
from vssm_gym.slam import report as slam_report
from vssm_gym.slam import states as slam_states
from vssm_gym.slam.figures import belief_at, observed_cells
from vssm_gym.slam.run import SlamRun, TrackedFrame
from vssm_gym.viz.mesh import surface_mesh

STD = np.array([0.003, 0.004, 0.005, 0.002, 0.003, 0.004, 0.05, 0.06, 0.07, 0.1, 0.2, 0.3])


def made_up_run(sequence, frames: int, seed: int = 0, **changes) -> SlamRun:
    """Make frames whose errors follow their covariance, with some fields changed (``at_3={...}``)."""
    rng = np.random.default_rng(seed)
    times, truth = sequence.truth
    start = inverse(truth[0])
    v = velocities(times, start @ truth)
    made = []
    for k in range(frames):
        error = STD * rng.standard_normal(12) * (k > 0)  # the first frame is the world
        T = np.asarray(start @ truth[k] @ np.asarray(se3_exp(jnp.asarray(error[:6]))), float)
        frame = TrackedFrame(
            index=k, time=times[k], T_world_cam=T, status=Status.OK, inlier_share=0.9, coverage=0.9, photometric=2.0,
            in_grid=1.0, read_s=0.01, wait_s=0.0, step_s=0.02, stages={"track": 0.012, "map": 0.004}, warm=k > 0,
            velocity=None if k == 0 else v[k - 1] + error[6:], covariance=None if k == 0 else np.diag(STD**2),
            left_window=0,
        )  # fmt: skip
        made.append(replace(frame, **changes.get(f"at_{k}", {})))
    m = VoxelMap.cube((0.0, 0.0, 0.0), 6.4, 0.08)
    belief = rigid_belief(RigidState(jnp.eye(4), jnp.zeros(6)), jnp.diag(jnp.asarray(STD**2, jnp.float32)))
    return SlamRun(tuple(made), Posterior(belief, m), FrameReader(sequence, (80, 60)), (), None)


@pytest.fixture(scope="module")
def long_sequence(tmp_path_factory):
    """Make 300 true poses that turn and move in all directions; only the first image exists and is read."""
    folder = write_sequence(tmp_path_factory.mktemp("long") / "room")
    sequence = load_sequence(folder)
    times = 1000.0 + 0.1 * np.arange(300)
    poses = np.stack([true_pose(k) for k in range(300)])
    return replace(sequence, truth=(times, poses))


def test_a_filter_whose_errors_follow_its_covariance_is_calibrated(long_sequence):
    """This holds in the camera's tangent and in the world; a wrong order, frame or side would change the NEES."""
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


def test_lost_frames_have_no_velocity_and_are_left_out_of_the_calibration(long_sequence):
    lost = {"status": Status.LOST, "covariance": np.eye(12), "velocity": np.zeros(6), "photometric": np.nan}
    run = made_up_run(long_sequence, 40, at_7=lost)
    truth = slam_states.Truth.of(run, long_sequence)
    mean, std = slam_states.velocity_bands(run)
    assert np.isnan(mean[[0, 7]]).all()
    assert np.isfinite(np.delete(mean, [0, 7], axis=0)).all()
    assert np.isfinite(np.delete(std, [0, 7], axis=0)).all()
    assert slam_states.calibrations(run, truth)["velocity"].whitened.shape == (38, 6)


@pytest.mark.slow
def test_the_report_shows_every_status(long_sequence):
    """A lost frame, one without depth, one relocalised, a grid that moved, a warning; and an empty map."""
    run = made_up_run(
        long_sequence,
        10,
        at_3={"status": Status.LOST, "photometric": np.nan, "stages": {"track": 0.01, "recover": 0.3}},
        at_4={"status": Status.NO_READING, "inlier_share": np.nan},
        at_5={"status": Status.RECOVERED, "left_window": 12, "stages": {"track": 0.01, "recover": 0.2}},
    )
    run = replace(run, notices=("rgb.txt: odd",))
    truth = slam_states.Truth.of(run, long_sequence)
    stats = slam_output.summarise(run, long_sequence, options(), 1.0, truth)
    assert json.loads(json.dumps(stats, allow_nan=False)) == stats
    assert [(frame["index"], frame["status"]) for frame in stats["lost"]] == [
        (3, Status.LOST.message),
        (4, Status.NO_READING.message),
    ]
    assert [frame["index"] for frame in stats["relocalised"]] == [5]
    assert stats["map"]["blocks_forgotten"] == 12
    assert stats["map"]["storage"] == "dense"
    assert stats["latency_ms"]["recover"]["n"] == 2
    assert stats["notices"] == ["rgb.txt: odd"]
    stats["map"] |= {"vertices": 0, "faces": 0}
    page = slam_report.page(run, long_sequence, truth, surface_mesh(run.map), stats, options().tracking)
    shown = " ".join(page.split())
    for text in ("2 of 10 frames were lost", "relocalised 1 time", "12 observed blocks", "1 warning.", "rgb.txt: odd"):
        assert text in shown
    for status in (Status.LOST, Status.NO_READING, Status.RECOVERED):
        assert status.message in shown


def test_no_text_of_a_run_becomes_markup(long_sequence, monkeypatch):
    """Names come from the recording's folder, from its files and from options; no figure shows one."""
    monkeypatch.setattr(slam_report.figures, "views", lambda run: (b"a picture", [(0, 0.01, 0.9)]))
    monkeypatch.setattr(slam_report.figures, "path", lambda *_: (b"a picture", 10.0))
    for module, names in (
        (slam_report.figures, ("slices", "fit", "latency", "calibration_curves")),
        (slam_states, ("velocity", "pose_std")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, lambda *_: b"a picture")
    run = made_up_run(long_sequence, 12, at_3={"status": Status.LOST, "photometric": np.nan})
    run = replace(run, notices=("rgb.txt: odd", "depth.txt: odd"))
    truth = slam_states.Truth.of(run, long_sequence)
    stats = slam_output.summarise(run, long_sequence, options(), 1.0, truth)
    mesh = SimpleNamespace(vertices=(), faces=())
    for known, errors in ((truth, stats["errors"]), (None, {"impossible": "two poses"})):
        seen = stats | {"errors": errors}
        shown = lambda change, known=known, seen=seen: slam_report.page(
            run, long_sequence, known, mesh, changed(seen, change), options().tracking
        )
        like = shown(harmless)
        for text in KINDS.values():
            check_page(shown(suffix(text)), like)
        assert MARKUP[0] in check_page(shown(suffix(MARKUP[0])), like).text


def stored_sparsely(m: VoxelMap, slots: int) -> VoxelMap:
    """Return the same belief with rows for the observed blocks only, in reverse order."""
    stored = np.flatnonzero((np.asarray(m.occupancy_precision) > OBSERVED_PRECISION).any(axis=1))[::-1]
    assert len(stored) < slots
    sparse = VoxelMap.prior(m.origin, float(m.voxel_size), m.shape, slots=slots)
    arrays = ("occupancy", "occupancy_precision", "colour", "colour_precision")
    rows = [getattr(sparse, name).at[1 : 1 + len(stored)].set(getattr(m, name)[stored]) for name in arrays]
    table = BlockTable.of(m.blocks, slots, stored)
    return eqx.tree_at(lambda s: (*(getattr(s, name) for name in arrays), s.table), sparse, (*rows, table))


def test_slices_read_a_sparse_map_as_a_dense_one():
    """Cells and known points are found by their storage row, without a dense copy of the cube."""
    image, config = RGBD.from_camera(*frame_of(0)), options().filter(CAMERA).config.update
    dense = update(options().prior().map, image.depth, image.rgb, jnp.eye(4), CAMERA, config)
    sparse = stored_sparsely(dense, 900)
    for below in (np.inf, -0.1):
        a, b = (np.array(sorted(map(tuple, observed_cells(m, below)))) for m in (dense, sparse))
        assert len(a) > 500
        np.testing.assert_allclose(a, b, atol=1e-6)
        at_cells = np.asarray(dense.occupancy_at(jnp.asarray(a, jnp.float32)))
        assert at_cells.max() < below + 1e-4
        assert (np.asarray(dense.precision(jnp.asarray(a, jnp.float32)))[:, 0] > 0.9).all()
    p = np.random.default_rng(0).uniform(-3.0, 3.0, (4000, 3))
    (mean, std), (sparse_mean, sparse_std) = belief_at(dense, p), belief_at(sparse, p)
    np.testing.assert_allclose(mean, sparse_mean, atol=1e-6)
    np.testing.assert_allclose(std, sparse_std, atol=1e-6)
    assert 0 < np.isfinite(mean).sum() < len(p)
    assert np.nanmax(std) <= 1.0


def test_exhausted_storage_is_reported(long_sequence):
    run = made_up_run(long_sequence, 2)
    full = eqx.tree_at(lambda m: m.table.refused, stored_sparsely(run.map, 8), jnp.int32(5))
    assert slam_output.notices(run) == ()
    (notice,) = slam_output.notices(replace(run, posterior=replace(run.posterior, map=full)))
    assert notice.startswith("the map's storage is full: 5 ")
