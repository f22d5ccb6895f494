"""Test that the numbers behind a track are part of its hash, and that content differs where images or poses do."""

from dataclasses import replace

import numpy as np
import pytest

from vssm_gym.envs.robots.holonomic import HOLONOMIC_NOISES
from vssm_gym.envs.sensors.rgbd_noise import PRESETS
from vssm_gym.eval.benchmark import rules
from vssm_gym.eval.benchmark.content import content_of

DRIVING = {
    "navigation": ("driving", "vssm_gym/PointNav-v0"),
    "car": ("driving", "vssm_gym/CarNav-v1"),
    "exploration": ("driving", "vssm_gym/Explore-v0"),
    "slam": ("slam", None),
    "prediction": ("prediction", None),
}


@pytest.mark.parametrize("track", DRIVING)
def test_a_number_that_changes_changes_the_hash(monkeypatch, track):
    before = rules.rules_hash(*DRIVING[track])
    assert before == rules.rules_hash(*DRIVING[track])
    with monkeypatch.context() as changed:
        changed.setitem(PRESETS, "kinect", replace(PRESETS["kinect"], growth=0.002))
        assert rules.rules_hash(*DRIVING[track]) != before
    name = {"car": "GOAL_RADIUS", "exploration": "COVERAGE_GOAL", "slam": "ASTRAY_ERROR"}.get(track, "MAX_DEPTH")
    monkeypatch.setattr(rules, name, 0.123)
    assert rules.rules_hash(*DRIVING[track]) != before


def test_levels_of_noise_are_stated_number_by_number():
    stated = rules.plain(rules.rules(*DRIVING["navigation"]))["noise"]
    assert stated.keys() == HOLONOMIC_NOISES.keys()
    assert all(set(map(type, level.values())) <= {str, bool, dict, list, type(None)} for level in stated.values())
    assert len({rules.rules_hash(*track) for track in DRIVING.values()}) == len(DRIVING)


def test_content_is_of_poses_and_images_beyond_the_last_digits():
    rng = np.random.default_rng(0)
    poses = rng.random((20, 4, 4))
    images = [(rng.integers(0, 256, (12, 16, 3)), 8.0 * rng.random((12, 16))) for _ in range(20)]
    found = content_of(poses, images)
    assert content_of(poses + 1e-7, [(rgb, depth + 1e-7) for rgb, depth in images]) == found
    assert content_of(poses + 0.01, images) != found
    assert content_of(poses, [(rgb, depth + 0.3) for rgb, depth in images]) != found
    assert content_of(poses, [(255 - rgb, depth) for rgb, depth in images]) != found
