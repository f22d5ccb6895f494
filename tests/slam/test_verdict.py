"""Test what a SLAM report warns about: loose alignments, covariances of a wrong size, lost frames and nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest

from vssm_gym.inference.status import Status
from vssm_gym.slam import verdict
from vssm_gym.slam.trajectory_error import align
from vssm_gym.slam.verdict import Alignment


def aligned(positions, noise, seed=0):
    """Return a run whose positions err by ``noise`` m an axis, after alignment, and its truth."""
    rng = np.random.default_rng(seed)
    estimate = positions + noise * rng.normal(size=positions.shape)
    found = align(estimate, positions)
    poses, true = (np.tile(np.eye(4), (len(positions), 1, 1)) for _ in range(2))
    poses[:, :3, 3], true[:, :3, 3] = estimate @ found.rotation.T + found.translation, positions
    return SimpleNamespace(poses=poses), SimpleNamespace(rows=np.arange(len(positions)), T_world_cam=true)


def test_a_walk_is_well_conditioned_and_a_turn_on_the_spot_is_not():
    t = np.linspace(0.0, 2.0 * np.pi, 80)
    loop = np.stack([np.cos(t), np.sin(t), 0.1 * np.sin(3.0 * t)], axis=-1)
    walk, spot = Alignment.of(*aligned(loop, 0.01)), Alignment.of(*aligned(0.02 * loop, 0.01))
    assert not walk.is_loose and spot.is_loose
    assert walk.spread == pytest.approx(np.sqrt(0.5), rel=0.02)
    assert walk.error == pytest.approx(0.01 * np.sqrt(3.0), rel=0.2)
    line = np.stack([np.linspace(0.0, 5.0, 80), 1e-3 * np.sin(5 * t), np.zeros(80)], axis=-1)
    assert Alignment.of(*aligned(line, 0.01)).is_loose  # the roll about the line is free, however long it is
    exact = Alignment.of(*aligned(0.02 * loop, 0.0))
    assert not exact.is_loose  # nothing to absorb


@pytest.mark.parametrize(
    ("ratio", "bias", "factor"),
    [(12.0, "overconfident", "12"), (0.25, "pessimistic", "4"), (1.9, "", "1.9"), (0.51, "", "1.96")],
)
def test_a_covariance_is_named_when_it_is_wrong_by_more_than_a_factor_of_two(ratio, bias, factor):
    assert (verdict.bias(ratio), verdict.factor(ratio)) == (bias, factor)
    found = verdict.warnings_of({"pose": {"nees_over_dimension": ratio}})
    assert found == ([{"state": "pose", "bias": bias, "factor": factor}] if bias else [])
    assert verdict.warnings_of(None) == []


def kinds(statuses, ratio):
    """Return the kind of each tile of a run with these statuses and a pose NEES / dimension."""
    frames = [SimpleNamespace(lost=not status.accepted, status=status) for status in statuses]
    run = SimpleNamespace(frames=frames)
    stats = {
        "errors": None,
        "calibration": {"pose": {"nees_over_dimension": ratio}},
        "real_time": {"factor": 0.8, "period_s": 0.1},
        "latency_ms": {"whole step": {"p50": 20.0, "p95": 30.0}},
        "map": {"voxel": 0.05, "shape": [64, 64, 32]},
    }
    return {tile.label: tile for tile in verdict.tiles(run, stats, None)}


def test_a_relocalised_frame_is_no_failure_and_a_wrong_covariance_is_not_green():
    again = kinds([Status.OK, Status.RECOVERED, Status.OK], 1.0)
    assert again["frames tracked"].kind == "good" and "relocalised 1 time" in again["frames tracked"].note
    assert again["pose NEES / dimension"].kind == "good"
    lost = kinds([Status.OK, Status.LOST, Status.RECOVERED], 12.0)
    assert (lost["frames tracked"].value, lost["frames tracked"].kind) == ("2", "bad")
    assert (lost["pose NEES / dimension"].kind, lost["pose NEES / dimension"].note) == ("warn", "overconfident")
    assert (lost["real-time factor"].value, lost["real-time factor"].kind) == ("0.80", "warn")
    assert lost["real-time factor"].note == "step 20.0 ms, 95 %: 30; an image every 100 ms"
