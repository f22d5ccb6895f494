"""Test traversals of mazes: they cover, repeat by seed, drift as path integration does, and log what was driven."""

import numpy as np
import pytest

from vssm_gym.data.traversals import Operator, errors, traverse
from vssm_gym.envs.physics.planar import scan
from vssm_gym.envs.tasks.maze_objectives import MazeCoverage
from vssm_gym.envs.tasks.mazes import MAZES, load_maze
from vssm_gym.errors import InputError
from vssm_gym.geometry.planar_poses import compose


@pytest.mark.parametrize("name", MAZES)
def test_a_traversal_covers_the_maze(name):
    maze = load_maze(name)
    log = traverse(maze, 3000, noise="none", sensor_noise="none")
    coverage = MazeCoverage(maze.space)
    for pose in log.poses:
        coverage.gained(pose[:2])
    assert coverage.ratio > 0.9


def test_scans_are_those_at_the_poses_and_motions_lead_from_one_to_the_next():
    maze = load_maze("rooms-v1")
    log = traverse(maze, 150, seed=3, noise="none", sensor_noise="none")
    assert len(log) == 151 and log.motions.shape == (150, 3)
    np.testing.assert_allclose(log.ranges, scan(log.poses, maze.rectangles, 64), atol=1e-5)
    np.testing.assert_allclose(errors(log, log.path()), 0.0, atol=1e-5)  # without noise nothing drifts
    np.testing.assert_allclose(errors(log, compose(np.array([3.0, 1.0, 0.4]), log.path())), 0.0, atol=1e-5)


@pytest.mark.slow
def test_path_integration_drifts_as_published():
    """0.14 +- 0.1 after 3000 steps (DVBF-LM, figure 4): here of four seeds in each of two mazes."""
    ends = [
        errors(log, log.path())[-1]
        for name in ("spiral-v1", "tree-v1")
        for log in (traverse(load_maze(name), 3000, seed) for seed in range(4))
    ]
    assert 0.04 < np.mean(ends) < 0.24


def test_the_same_seed_is_the_same_traversal():
    maze = load_maze("tree-v1")
    first, again, other = (traverse(maze, 60, seed) for seed in (1, 1, 2))
    for name in ("ranges", "motions", "poses"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.motions, other.motions)


def test_commands_are_within_the_limits():
    maze = load_maze("slanted-v1")
    log = traverse(maze, 300, noise="none")
    limits = maze_limits()
    assert (np.abs(log.motions[:, 2]) <= limits[0] + 1e-9).all() and (log.motions[:, 0] <= limits[2] + 1e-9).all()
    assert (log.motions[:, 0] >= 0.0).all() and (log.motions[:, 1] == 0.0).all()


def maze_limits() -> np.ndarray:
    from vssm_gym.envs.tasks.mazes import ROBOT

    return ROBOT.limits


def test_an_operator_off_the_free_space_returns_to_it():
    maze = load_maze("rooms-v1")
    turn, step, stop = Operator(maze, 0)(np.array([0.001, 0.001, 0.0]))
    assert np.isfinite([turn, step]).all() and stop == 0.0


def test_no_steps_are_refused():
    with pytest.raises(InputError, match="steps: expected at least 1, not 0"):
        traverse(load_maze("rooms-v1"), 0)
