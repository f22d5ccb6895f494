"""Test ``vssm-gym slam --refine``: the trajectory gets better, the map follows, lost frames stay out of it."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.slam_recordings import FILES, FRAMES, GRID, ROOM, SIZE, names, poses_of, true_pose, write_sequence
from vssm_gym.cli.slam import slam
from vssm_gym.data.sequences import load_sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_exp, transform
from vssm_gym.inference.smoothing.gauss_newton import SmoothingConfig
from vssm_gym.model.posterior import Posterior
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.refinement import carried, refine
from vssm_gym.slam.refinement_figures import COMPARED_FRAMES, compared, depth_differences
from vssm_gym.slam.run import run_slam
from vssm_gym.viz.mesh import surface_mesh

OPTIONS = SlamOptions(size=(80, 60), voxel=0.08, extent=6.4, refine=True)
TRUE = inverse(true_pose(0)) @ np.stack([true_pose(k) for k in range(FRAMES)])


SIDEWAYS = np.eye(4)
SIDEWAYS[2, 3] = 0.03  # m, along the view


def errors(T_world_cam: np.ndarray) -> np.ndarray:
    return np.linalg.norm(T_world_cam[:, :3, 3] - TRUE[:, :3, 3], axis=1)


@pytest.fixture(scope="module")
def filtered(tmp_path_factory):
    folder = write_sequence(tmp_path_factory.mktemp("refined") / "room", strange=4)
    return run_slam(load_sequence(folder), OPTIONS)


@pytest.fixture(scope="module")
def refined(filtered):
    return refine(filtered, OPTIONS)


@pytest.mark.slow
def test_frames_move_and_keep_their_status(filtered, refined):
    run = refined.run
    assert [frame.status for frame in run.frames] == [frame.status for frame in filtered.frames]
    kept = ~run.lost
    assert kept.sum() == FRAMES - 1
    assert refined.nodes.tolist() == np.flatnonzero(kept).tolist()
    assert errors(run.poses)[kept].max() < 0.006
    np.testing.assert_allclose(run.poses[0], np.eye(4), atol=1e-3)
    std = np.array([np.sqrt(np.trace(frame.covariance[:3, :3]) / 3.0) for frame in run.frames])
    assert (std[1:] < 0.02).all()


def test_poses_that_were_disturbed_are_found_again(filtered):
    xi = np.random.default_rng(0).normal(0.0, 0.008, (FRAMES, 6))
    xi[0] = 0.0
    off = filtered.poses @ np.asarray(se3_exp(jnp.asarray(xi, jnp.float32)), np.float64)
    run = replace(filtered, frames=tuple(replace(f, T_world_cam=T) for f, T in zip(filtered.frames, off, strict=True)))
    kept = ~run.lost
    assert errors(refine(run, OPTIONS).run.poses)[kept].mean() < 0.3 * errors(run.poses)[kept].mean()


def test_the_map_is_that_of_the_smoothed_poses(refined):
    vertices = surface_mesh(refined.run.map).vertices
    off = np.abs(ROOM.occupancy(transform(true_pose(0), np.asarray(vertices, float))))
    assert len(vertices) > 500
    assert np.median(off) < 0.1 * 0.08
    assert refined.run.map.pose_errors is not None


def test_images_are_compared_with_each_map_at_its_own_poses(filtered, refined):
    """A map agrees with the images that it was made of to a tenth of a cell; seen from 3 cm off it does not."""
    moved = [replace(f, T_world_cam=f.T_world_cam @ SIDEWAYS) for f in filtered.frames]
    numbers = depth_differences(replace(refined, filtered=replace(filtered, frames=tuple(moved))))
    assert [index for index, _, _ in numbers] == [refined.run.frames[i].index for i in compared(refined)]
    assert len({index for index, _, _ in numbers}) == COMPARED_FRAMES
    for _, before, after in numbers:
        assert after < 0.1 * 0.08
        assert before > 2.0 * after


def test_a_run_that_was_not_smoothed_has_no_such_section(filtered):
    short = refine(replace(filtered, frames=filtered.frames[:2]), OPTIONS)
    assert short.costs == [] and short.run is short.filtered


def test_the_posterior_is_saved_and_read(refined, tmp_path):
    path = tmp_path / "map.npz"
    refined.run.posterior.save(path)
    again = Posterior.load(path)
    np.testing.assert_allclose(again.belief.covariance, refined.run.posterior.belief.covariance, rtol=1e-5, atol=1e-9)
    assert again.map is not None and again.map.pose_errors is not None


def test_a_run_of_two_frames_is_returned_as_it_is(filtered):
    short = replace(filtered, frames=filtered.frames[:2])
    assert refine(short, OPTIONS).run is short


def test_what_lies_between_corrected_poses_moves_with_both():
    """Between two equal corrections each pose gets it; half-way between two others the mean; outside the nearest."""
    T = np.tile(np.eye(4), (7, 1, 1))
    T[:, 0, 3] = np.arange(7.0)
    nodes = np.array([1, 3, 5])
    shifted = T[nodes].copy()
    shifted[:, 1, 3] = 0.1, 0.1, 0.3
    moved = carried(T, nodes, shifted)
    np.testing.assert_allclose(moved[:, 1, 3], [0.1, 0.1, 0.1, 0.1, 0.2, 0.3, 0.3], atol=1e-6)
    np.testing.assert_allclose(moved[:, 0, 3], T[:, 0, 3], atol=1e-6)
    turned = T[nodes] @ np.asarray(se3_exp(jnp.asarray([[0, 0, 0, 0, 0, 0.2]] * 3, jnp.float32)), float)
    np.testing.assert_array_equal(carried(T, nodes, turned)[nodes], turned)


@pytest.mark.slow
def test_the_command_writes_the_smoothed_trajectory(tmp_path, capsys):
    folder, out = write_sequence(tmp_path / "room"), tmp_path / "out"
    slam(folder, out, size=SIZE, voxel=float(GRID[1]), extent=float(GRID[3]), refine=True)
    assert "before it was refined" in capsys.readouterr().out
    assert names(out) == FILES
    stats = json.loads((out / "stats.json").read_text())
    assert stats["config"]["refine"] is True
    assert len(stats["refinement"]["costs"]) == len(SmoothingConfig().gates)
    _, poses = poses_of(out / "trajectory.txt")
    assert errors(poses).max() < 0.006
    report = (out / "report.html").read_text()
    assert "before smoothing" in report and 'id="refinement"' in report


def test_a_given_map_cannot_be_refined(tmp_path):
    with pytest.raises(InputError, match="refine"):
        SlamOptions(method="tracker", map=tmp_path / "map.npz", refine=True)
