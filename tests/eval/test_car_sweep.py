"""Test the robot car end to end: 52 of the 1000 targets of ``car.yaml``, on maps that PRISM made of recorded drives.

A car that misses a target, or collides in more than one run, fails the test.
"""

import json

import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.maps.voxel_map import read_metadata

CONFIG = CHECKOUT / "eval" / "configs" / "car.yaml"
SCENES = ("dock", "garage")  # those with the shortest drives to map
TARGETS = 13  # a scene and simulator


@pytest.mark.slow
def test_the_car_reaches_fifty_targets(tmp_path):
    pytest.importorskip("pybullet", reason="half of the targets are driven in PyBullet: vssm-gym[bullet]")
    config = load_config(CONFIG).model_copy(update={"scenes": SCENES, "tasks": tuple(range(TARGETS))})
    log = run_sweep(config, tmp_path / "sweep", workers=1)
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(rows) == 52
    assert {(row["scene"], row["physics"]) for row in rows} == {(s, p) for s in SCENES for p in config.physics}
    missed = [(row["scene"], row["physics"], row["task"], row["failure"]) for row in rows if not row["success"]]
    assert missed == []
    assert sum(row["collided"] > 0 for row in rows) <= 1  # of 52: what one run in a hundred allows
    for scene in SCENES:
        assert read_metadata(tmp_path / "sweep" / "maps" / f"{scene}.npz")["poses"] == "estimated"
