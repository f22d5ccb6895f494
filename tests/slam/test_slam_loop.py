"""Test the loop of ``slam``: the start of a map, lost frames, real images."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.slam_recordings import FRAMES, frame_of, image_from, options, true_pose, write_sequence
from vssm_gym.data.sequences import load_sequence
from vssm_gym.geometry.transforms import inverse
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import run_slam


@pytest.mark.slow
def test_the_map_starts_at_the_first_depth(tmp_path):
    run = run_slam(load_sequence(write_sequence(tmp_path / "room", blank=2)), options())
    assert run.lost.tolist() == [True, True] + [False] * (FRAMES - 2)
    np.testing.assert_array_equal(run.poses[:3], np.tile(np.eye(4), (3, 1, 1)))
    expected = inverse(true_pose(2)) @ true_pose(FRAMES - 1)
    assert np.linalg.norm(run.poses[-1, :3, 3] - expected[:3, 3]) < 0.02


@pytest.mark.parametrize("first", ["a strip", "another place"])
def test_a_map_that_starts_from_a_bad_image_is_restarted(tmp_path, first):
    """No image fits it: after three readable frames the map is restarted, which is reported."""
    rgb, depth = frame_of(0)
    bad = {
        "a strip": (rgb, depth * (np.arange(80) < 8)),
        "another place": image_from(camera_pose((0.2, 0.3, 1.2), 2.7, 0.4)),
    }[first]
    run = run_slam(load_sequence(write_sequence(tmp_path / "room", first=bad)), options())
    assert run.lost.tolist() == [True] * 4 + [False] * (FRAMES - 4)
    assert any("restarted at frame 4" in notice for notice in run.notices)
    expected = inverse(true_pose(4)) @ true_pose(FRAMES - 1)
    assert np.linalg.norm(run.poses[-1, :3, 3] - expected[:3, 3]) < 0.02


def test_a_black_first_image_is_tracked_by_its_depth(tmp_path):
    rgb, depth = frame_of(0)
    run = run_slam(load_sequence(write_sequence(tmp_path / "room", first=(0 * rgb, depth))), options())
    assert not run.lost.any()
    expected = inverse(true_pose(0)) @ true_pose(FRAMES - 1)
    assert np.linalg.norm(run.poses[-1, :3, 3] - expected[:3, 3]) < 0.03


def test_real_images_are_tracked(shared_data):
    """The first 12 frames of TUM fr1_xyz: the camera moves 20 cm."""
    sequence = load_sequence(shared_data / "tum_fr1_xyz")
    run = run_slam(replace(sequence, frames=sequence.frames[:12]), options())
    assert not run.lost.any()
    result = trajectory_error.evaluate(run.times, run.poses, *sequence.truth)
    assert result["ate_translation_se3"]["rmse"] < 0.02


@pytest.mark.slow
def test_the_whole_real_sequence_at_the_default_settings(shared_data):
    sequence = load_sequence(shared_data / "tum_fr1_xyz")
    run = run_slam(sequence, SlamOptions())
    result = trajectory_error.evaluate(run.times, run.poses, *sequence.truth)
    assert len(run.frames) == 266
    assert result["ate_translation_se3"]["rmse"] < 0.03
    assert run.lost.mean() < 0.05
