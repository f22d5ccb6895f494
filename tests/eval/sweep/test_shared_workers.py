"""Test that a worker that has run episodes in other scenes runs the next as a new one does."""

import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.runner import run_sweep

OF_THE_RUN = ("latency", "config_hash")  # fields that differ between sweeps of different scenes


@pytest.fixture
def scenes(tmp_path):
    """Write two apartments that differ in what is inside."""
    table = furniture("table", (1.0, 0.9, 0.4), (0.8, 0.6, 0.8))
    save_scene(two_rooms(), tmp_path / "empty.json")
    save_scene(two_rooms(openness=0.7, leaves=1, pieces=(table,)), tmp_path / "furnished.json")
    return ["empty.json", "furnished.json"]


def sweep_rows(folder, scenes):
    """Run a task of slam_nav in each scene in one worker; return the rows."""
    name = "-".join(scene.removesuffix(".json") for scene in scenes)
    config = folder / f"{name}.yaml"
    config.write_text(f"scenes: [{', '.join(scenes)}]\nagents: slam_nav\nnoise: mid\nsensor_noise: kinect\ntasks: 1\n")
    return read_rows(run_sweep(load_config(config), folder / name, workers=1))


@pytest.mark.slow
def test_a_scene_before_changes_no_row(scenes, tmp_path):
    (_, after), (alone,) = sweep_rows(tmp_path, scenes), sweep_rows(tmp_path, scenes[1:])
    assert after["steps"] > 5
    assert {k: v for k, v in after.items() if k not in OF_THE_RUN} == {
        k: v for k, v in alone.items() if k not in OF_THE_RUN
    }
