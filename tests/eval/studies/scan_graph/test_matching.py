"""Test scan matching on known motions, against finite differences and on what no scan can tell."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from tests.eval.studies.scan_graph.corridor import ALONG, BEAMS, REACH, WALLS, box, drive, scans
from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.eval.studies.scan_graph import correlative
from vssm_gym.eval.studies.scan_graph.clouds import Points, points_of, surface, together
from vssm_gym.eval.studies.scan_graph.matching import match
from vssm_gym.geometry.planar_poses import compose, relation

CELL = 0.1
CORNER = np.array([ALONG[0] + 0.4, ALONG[0] + 0.1, 0.3])
NONE = np.zeros((0, 2), int), np.zeros((0, 3))


def seen(poses, seed=0, walls=WALLS, noise=0.01, mount=(0.0, 0.0, 0.0)):
    poses = np.atleast_2d(poses)
    at = compose(poses, np.broadcast_to(mount, poses.shape))
    angles = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
    log = LaserLog(
        scans(at, seed, walls, noise), angles, REACH, np.array(mount), np.zeros((len(poses) - 1, 3)), None, *NONE
    )
    return [points_of(log, k, REACH) for k in range(len(poses))]


def corner_cloud(walls=WALLS, noise=0.01, around=CORNER):
    """Return the surface that ten scans around a place see, in the world's frame."""
    poses = around + np.random.default_rng(3).normal(size=(10, 3)) * [0.15, 0.15, 0.5]
    parts = seen(poses, 7, walls, noise)
    return surface(together([p.moved(pose) for p, pose in zip(parts, poses, strict=True)]), CELL)


CLOUD = corner_cloud()


def test_points_lie_on_the_walls_wherever_the_scanner_is_mounted():
    pose = np.array([5.25, 1.0, 0.4])
    [points] = seen(pose, noise=0.0, mount=(-0.2, 0.1, 0.7))
    places = points.moved(pose).places
    off = np.minimum.reduce([np.abs(places[:, 1]), np.abs(places[:, 1] - 2.0)])
    assert off.max() < 1e-6
    scanner = compose(pose, np.array([-0.2, 0.1, 0.7]))[:2]
    towards = scanner - places
    np.testing.assert_allclose(points.moved(pose).views, towards / np.hypot(*towards.T)[:, None], atol=1e-6)


def test_normals_are_those_of_the_walls_and_face_the_scanner():
    assert len(CLOUD.places) > 50
    upright = np.abs(CLOUD.normals).max(axis=1)
    assert np.median(upright) > 0.998 and np.quantile(upright, 0.1) > 0.97
    assert ((CORNER[:2] - CLOUD.places) * CLOUD.normals).sum(axis=1).min() > 0.0


def test_a_thin_wall_has_two_surfaces():
    rng = np.random.default_rng(0)
    x = rng.uniform(0.0, 1.0, 200)
    front = Points(np.stack([x, np.full(200, 0.0)], -1), np.tile([0.0, -1.0], (200, 1)))
    back = Points(np.stack([x, np.full(200, 0.04)], -1), np.tile([0.0, 1.0], (200, 1)))
    cloud = surface(together([front, back]), CELL)
    for sign, y in ((-1.0, 0.0), (1.0, 0.04)):
        np.testing.assert_allclose(cloud.places[cloud.normals[:, 1] * sign > 0.9][:, 1], y, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(dx=st.floats(-0.25, 0.25), dy=st.floats(-0.25, 0.25), turn=st.floats(-0.25, 0.25), seed=st.integers(0, 1000))
def test_a_known_motion_is_recovered(dx, dy, turn, seed):
    [points] = seen(CORNER, seed)
    found = match(CLOUD, points, compose(CORNER, np.array([dx, dy, turn])), CELL)
    error = relation(CORNER, found.pose)
    assert np.hypot(*error[:2]) < 0.012 and abs(error[2]) < 0.01
    assert found.share > 0.85


def test_the_optimum_is_that_of_the_written_cost():
    """The oracle minimises the cost by a method that knows no derivative."""
    [points] = seen(CORNER, 5)
    prior = compose(CORNER, np.array([0.02, -0.01, 0.01])), np.diag([1e5, 1e5, 1e5])
    found = match(CLOUD, points, CORNER, CELL, prior)

    def cost(pose):
        at = points.moved(pose)
        apart, nearest = CLOUD.tree.query(at.places, distance_upper_bound=2.5 * CELL)
        met = np.isfinite(apart)
        met[met] &= (CLOUD.normals[nearest[met]] * at.views[met]).sum(axis=1) > 0.1
        k, away = nearest[met], at.places[met] - CLOUD.places[nearest[met]]
        residual = (away * CLOUD.normals[k]).sum(axis=1)
        along = (away**2).sum(axis=1) - residual**2
        variance = found.noise**2 * (1.0 + (1.0 + along / CLOUD.spread[k]) / CLOUD.mass[k])
        error = relation(pose, prior[0])
        return 2.0 * np.log1p(0.25 * residual**2 / variance).sum() + 0.5 * error @ prior[1] @ error

    # Associations make the cost jump: the optimum is where no nearby pose is better by more than a jump
    best = minimize(cost, found.pose, method="Nelder-Mead", options={"xatol": 1e-6, "initial_simplex": _around(found)})
    error = relation(found.pose, best.x)
    assert np.hypot(*error[:2]) < 0.004 and abs(error[2]) < 0.004


def _around(found):
    return found.pose + 0.01 * np.vstack([np.zeros(3), np.eye(3)])


def test_errors_are_as_large_as_stated():
    """The mean squared error in the stated covariance, of forty scans, is near its three degrees of freedom."""
    squared = []
    for seed in range(40):
        [points] = seen(CORNER, 100 + seed)
        found = match(CLOUD, points, CORNER, CELL)
        error = relation(found.pose, CORNER)
        squared.append(error @ found.information @ error)
    assert 1.0 < np.mean(squared) < 12.0


def test_a_corridor_says_nothing_along_it():
    walls, middle = np.array([box(-10, 20, -0.2, 0.0), box(-10, 20, 2.0, 2.2)]), np.array([5.0, 1.0, 0.6])
    cloud = corner_cloud(walls, around=middle)
    [points] = seen(middle, walls=walls)
    found = match(cloud, points, compose(middle, np.array([0.1, 0.05, 0.02])), CELL)
    c, s = np.cos(middle[2]), np.sin(middle[2])
    along, across = np.array([c, -s, 0.0]), np.array([s, c, 0.0])  # in the robot's frame
    assert along @ found.information @ along < 1e-2 * (across @ found.information @ across)
    assert abs(found.pose[1] - 1.0) < 0.01


def test_a_prior_holds_a_scan_without_readings():
    mean = np.array([1.0, 2.0, 0.3])
    nothing = Points(np.zeros((0, 2)), np.zeros((0, 2)))
    found = match(CLOUD, nothing, np.zeros(3), CELL, (mean, np.eye(3)))
    np.testing.assert_array_equal(found.pose, mean)
    assert found.share == 0.0 and not found.information.any()


def test_the_coarse_field_bounds_the_fine_one():
    fields = correlative.field(CLOUD, CELL)
    w, h = fields.fine.shape
    for i, j in np.ndindex(correlative.SEARCH_BLOCK, correlative.SEARCH_BLOCK):
        assert (fields.coarse[: w - i, : h - j] >= fields.fine[i:, j:] - 1e-12).all()


@pytest.mark.parametrize("off", [(0.9, -0.7, 0.4), (-0.8, 0.9, -0.5), (0.3, 0.2, 0.1)])
def test_a_search_finds_the_best_pose_of_all(off):
    """Branch and bound gives the maximum of an exhaustive search, and ICP from there the true pose."""
    [points] = seen(CORNER, 9)
    fields, centre = correlative.field(CLOUD, CELL), CORNER + off
    peak = correlative.search(fields, points, centre, CELL, 1.2, 0.6)
    error = relation(CORNER, peak.pose)
    assert np.hypot(*error[:2]) < 0.15 and abs(error[2]) < 0.06
    best = 0.0
    for heading in np.unique(np.append(peak.pose[2], np.linspace(centre[2] - 0.6, centre[2] + 0.6, 25))):
        at = points.moved(np.array([*centre[:2], heading]))
        cells = np.floor((at.places[:: max(1, len(points) // 90)] - fields.low) / CELL).astype(int)
        offsets = np.stack(np.meshgrid(*2 * [np.arange(-12, 12)], indexing="ij"), -1).reshape(-1, 2)
        best = max(best, correlative._score(fields.fine, cells, offsets).max())
    assert peak.score >= best - 1e-9
    found = match(CLOUD, points, peak.pose, CELL, reach=3.0)
    error = relation(CORNER, found.pose)
    assert np.hypot(*error[:2]) < 0.012 and abs(error[2]) < 0.01


def test_a_search_that_cannot_end_says_that_the_place_has_rivals(monkeypatch):
    monkeypatch.setattr(correlative, "MOST_EXPANDED", 2)
    [points] = seen(CORNER, 9)
    peak = correlative.search(
        correlative.field(CLOUD, CELL), points, CORNER + np.array([0.7, 0.6, 0.4]), CELL, 1.2, 0.6
    )
    assert peak.rival == peak.score > 0.0


def test_a_search_along_a_corridor_has_a_rival():
    log = drive()
    middle = np.array([5.0, 1.0, 0.0])
    cloud = corner_cloud(around=middle)
    peak = correlative.search(correlative.field(cloud, CELL), points_of(log, 30, REACH), middle, CELL, 1.5, 0.3)
    assert peak.rival > 0.95 * peak.score > 0.4
