"""Test ``vssm-gym slam --method smoother``: no filter, the same results in the folder, and its own options."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.slam_recordings import FILES, FRAMES, names, poses_of, true_pose, write_sequence
from vssm_gym.cli.slam import slam
from vssm_gym.data.sequences import load_sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.refinement import refine
from vssm_gym.slam.run import run_slam
from vssm_gym.viz.mesh import surface_mesh

OPTIONS = {"size": "80x60", "voxel": 0.08, "extent": 6.4}
TRUE = inverse(true_pose(0)) @ np.stack([true_pose(k) for k in range(FRAMES)])


@pytest.mark.slow
def test_a_recording_is_smoothed_from_nothing(tmp_path):
    folder, out = write_sequence(tmp_path / "room", strange=4), tmp_path / "out"
    slam(folder, out=out, method="smoother", **OPTIONS)
    assert names(out) == FILES
    stats = json.loads((out / "stats.json").read_text())
    assert stats["config"]["method"] == "smoother"
    assert [one["index"] for one in stats["lost"]] == [4]  # an image of another place
    assert stats["refinement"]["frames"] == FRAMES - 1
    assert stats["latency_ms"].keys() >= {"track", "smooth", "map"}
    assert "samples" not in stats["config"]
    _, poses = poses_of(out / "trajectory.txt")
    off = np.linalg.norm(poses[:, :3, 3] - TRUE[:, :3, 3], axis=1)
    assert np.delete(off, 4).max() < 0.006
    assert 'id="refinement"' in (out / "report.html").read_text()


@pytest.mark.slow
def test_two_images_are_mapped_although_nothing_is_smoothed(tmp_path):
    folder = write_sequence(tmp_path / "room", blank=FRAMES - 2)
    options = SlamOptions(size=(80, 60), voxel=0.08, extent=6.4, method="smoother")
    run = run_slam(load_sequence(folder), options)
    assert (~run.lost).sum() == 2
    found = refine(run, options)
    np.testing.assert_array_equal(found.run.poses, run.poses)
    assert len(surface_mesh(found.run.map).vertices) > 100


def test_options_that_do_not_apply_are_refused(tmp_path):
    options = SlamOptions(method="smoother")
    with pytest.raises(InputError, match="smoothed at the end in any case"):
        replace(options, refine=True)
    for changed in ({"solver": "adam"}, {"samples": 3}, {"learn_camera": True}):
        with pytest.raises(InputError, match=next(iter(changed)).replace("_", "-")):
            replace(options, **changed)
    with pytest.raises(InputError, match="map"):
        replace(options, map=tmp_path / "map.npz")
    with pytest.raises(InputError, match="start"):
        replace(options, start=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
