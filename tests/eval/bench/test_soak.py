"""Test the gates of the soak test: each property that it checks is violated once."""

from importlib.util import find_spec

import numpy as np
import pytest

import vssm_gym.eval.bench.soak as module
from vssm_gym.envs.simulation import Simulation
from vssm_gym.eval.bench.soak import SoakError, soak

STEPS = 28  # two a world
APARTMENTS = 3  # one of each size
GROWTH = 400.0  # MB: two steps a world fill caches, in a process that holds those of other tests


@pytest.fixture(autouse=True)
def few_worlds(monkeypatch):
    monkeypatch.setattr(module, "PROCEDURAL", APARTMENTS)
    monkeypatch.setattr(module, "GROWTH", GROWTH)


@pytest.mark.slow
def test_the_environments_pass():
    result = soak(steps=STEPS)
    assert len(result["rows"]) == 3 * APARTMENTS + 4 + bool(find_spec("pybullet"))
    assert result["steps"] >= STEPS
    assert {row[0] for row in result["rows"]} == {
        *("PointNav-v0", "ImageNav-v0", "Explore-v0", "LidarMaze-v0", "Flight-v0", "CarNav-v0")
    }


def test_a_robot_beyond_a_wall_is_found(monkeypatch):
    drive = Simulation.drive

    def tunnel(self, command):
        collided = drive(self, command)
        self.world.data.qpos[0] += 40.0
        return collided

    monkeypatch.setattr(Simulation, "drive", tunnel)
    with pytest.raises(SoakError, match="PointNav"):
        soak(steps=STEPS)


def test_a_nan_is_found(monkeypatch):
    observe = Simulation.observation

    def broken(self):
        return observe(self) | {"depth": np.full((30, 40), np.nan, np.float32)}

    monkeypatch.setattr(Simulation, "observation", broken)
    with pytest.raises(SoakError, match="step 0"):
        soak(steps=STEPS)


def test_a_leak_is_found(monkeypatch):
    held = iter([100.0, 101.0 + GROWTH])
    monkeypatch.setattr(module, "_resident_mb", lambda: next(held))
    monkeypatch.setattr(module, "_drive", lambda *_: (2, 1, 0, 0.0))  # memory alone is checked here
    with pytest.raises(SoakError, match="memory grew from 100 to 501 MB"):
        soak(steps=STEPS)
