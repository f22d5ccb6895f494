"""Test the study of the flow over a pose: what it measures, and all of it from end to end with little effort."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from vssm_gym.cli.studies import posteriors as commands
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.pose_flow import study as pose_flow_study
from vssm_gym.eval.studies.pose_flow.ball import DISTANCE, ball_in_camera, true_pose
from vssm_gym.eval.studies.pose_flow.study import NAMES, PATCHES, covered
from vssm_gym.inference.smoothing.pose_posterior import FitConfig


def test_the_covered_share_is_that_of_the_sphere() -> None:
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    assert covered(directions) > 0.98
    assert 0.4 < covered(directions[directions[:, 2] > 0.0]) < 0.6
    assert covered(np.tile([[0.0, 0.3, 1.0]], (10, 1))) == pytest.approx(1.0 / PATCHES)


def test_the_true_camera_looks_at_the_ball() -> None:
    np.testing.assert_allclose(ball_in_camera(true_pose()[None])[0], [0.0, 0.0, DISTANCE], atol=1e-6)


def test_the_correlated_gaussian_starts_around_the_ball() -> None:
    """Its rotations are wide, and the ball stays in the centre of nearly all of its draws."""
    T = np.asarray(pose_flow_study._around_the_ball().draw(jax.random.key(0), 512).states[:, 0])
    measured = pose_flow_study._measured(T)
    assert measured["centred"] > 0.95
    assert measured["distance_rmse"] < 0.01
    assert measured["covered"] > 0.2


def test_a_bad_seed_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seed"):
        commands.pose_flow(out=tmp_path / "out", seed=-1)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_study_runs_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few steps from wide starts: every figure is defined, and the command writes them."""
    little = FitConfig(rounds=3, draws=64, fits=2, steps=3, samples=4)
    for name, value in {"GAUSSIAN": little, "CORRELATED": little, "FLOW": little, "POSTERIOR_DRAWS": 64}.items():
        monkeypatch.setattr(pose_flow_study, name, value)
    commands.pose_flow(out=tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "pose-flow.json").read_text())["figures"]
    assert tuple(stored["by_family"]) == NAMES
    assert stored["by_family"]["flow"]["elbo"] < stored["log_evidence"]
    assert 0.0 < sum(stored["by_family"]["flow"]["shares"]) <= 1.0 + 1e-5
    assert (tmp_path / "out" / "pose-flow.html").is_file()
