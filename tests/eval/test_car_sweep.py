"""Test the robot car end to end: 12 of the 1000 targets of ``car.yaml``, on a map that PRISM made of a recorded drive.

A car that misses a target, or collides, fails the test: the committed rows of these targets have neither.
"""

import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.maps.voxel_map import read_metadata

CONFIG = CHECKOUT / "eval" / "configs" / "car.yaml"
SCENE = "dock"  # that with the shortest drive to map
TARGETS = 3  # a simulator


@pytest.mark.slow
def test_the_car_reaches_every_target(tmp_path):
    pytest.importorskip("pybullet", reason="half of the targets are driven in PyBullet: vssm-gym[bullet]")
    config = load_config(CONFIG).model_copy(update={"scenes": (SCENE,), "tasks": tuple(range(TARGETS))})
    log = run_sweep(config, tmp_path / "sweep", workers=1)
    rows = read_rows(log)
    assert len(rows) == 2 * TARGETS
    assert {row["physics"] for row in rows} == set(config.physics)
    assert [(row["physics"], row["task"], row["failure"]) for row in rows if not row["success"]] == []
    assert [(row["physics"], row["task"]) for row in rows if row["collided"]] == []
    assert read_metadata(tmp_path / "sweep" / "maps" / f"{SCENE}.npz")["poses"] == "estimated"
