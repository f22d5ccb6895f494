"""Test expected information on a map learned in an apartment: sparse pixels, true gains, and ``bench information``."""

import json

import numpy as np
import pytest
from scipy.stats import spearmanr

from vssm_gym.cli.bench import bench
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors import CameraConfig, make_camera
from vssm_gym.errors import InputError
from vssm_gym.eval.bench import information as bench_information
from vssm_gym.planning.exploration.information import InformationConfig, expected_gain


@pytest.mark.slow
def test_sparse_pixels_rank_candidates_as_all_pixels_and_as_the_true_gain():
    apartment, robot = load_scene("oak"), HolonomicRobot()
    eye = make_camera(apartment.boxes(), CameraConfig())
    looks = bench_information.survey_poses(apartment, robot, seed=1)
    m = bench_information.learned(apartment, eye, looks[:24])
    T = bench_information.candidate_trajectories(m, apartment, robot, 40, np.random.default_rng(1))
    exact = expected_gain(m, T, eye.camera, bench_information.ALL).total
    default = expected_gain(m, T, eye.camera, InformationConfig()).total
    assert spearmanr(default, exact).statistic >= 0.95
    assert spearmanr(default, bench_information.true_gain(m, T, eye)).statistic >= 0.8


@pytest.mark.slow
def test_the_benchmark_writes_its_measurements(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_information, "VIEWPOINTS", (2,))
    chosen = {name: bench_information.ESTIMATES[name] for name in ("default", "all pixels and cells")}
    monkeypatch.setattr(bench_information, "ESTIMATES", chosen)
    bench("information", out=tmp_path, trials=6)
    result = json.loads((tmp_path / "information-oak.json").read_text())
    assert [row["what"] for row in result["rows"]] == list(chosen)
    assert result["rows"][1]["rank"] == 1.0 and result["recompilations"] == 0
    assert all(row["ms"] > 0 and row["map"] == 16 and row["entropy"] < 0 for row in result["rows"])
    assert "all pixels and cells" in capsys.readouterr().out


def test_too_few_candidates_to_rank_are_refused(tmp_path):
    with pytest.raises(InputError, match="trials"):
        bench("information", out=tmp_path, trials=2)
