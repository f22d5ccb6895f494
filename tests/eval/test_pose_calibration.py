"""Test the calibration of an episode's poses: against dense algebra, and on errors drawn from what is stated."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import logm
from scipy.stats import chi2

from vssm_gym.eval.metrics.aggregate import bootstrap_mean
from vssm_gym.eval.metrics.pose_calibration import RESOLUTION, inside_region, pose_calibration

COVARIANCE = np.array([[0.04, 0.012, -0.004], [0.012, 0.01, 0.002], [-0.004, 0.002, 0.003]])  # of (forward, left, turn)


def matrix(planar):
    """Return a pose of the plane as a 3 x 3 matrix."""
    x, y, heading = planar
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def moved(planar, xi):
    """``T exp(xi)``: along an arc of the turn's angle, poses and errors (n, 3)."""
    v, turn = xi[:, 0] + 1j * xi[:, 1], xi[:, 2]
    xy = planar[:, 0] + 1j * planar[:, 1] + np.exp(1j * planar[:, 2]) * v * (np.exp(1j * turn) - 1.0) / (1j * turn)
    return np.stack([xy.real, xy.imag, planar[:, 2] + turn], axis=1)


def drawn(rng, steps, covariance=COVARIANCE):
    """Return estimates, and truths whose errors about them have a covariance."""
    estimates = rng.uniform([-5.0, -5.0, -3.1], [5.0, 5.0, 3.1], (steps, 3))
    errors = rng.multivariate_normal(np.zeros(3), covariance, steps)
    return estimates, moved(estimates, errors)


@given(
    estimate=st.tuples(*[st.floats(-4.0, 4.0)] * 2, st.floats(-3.0, 3.0)),
    truth=st.tuples(*[st.floats(-4.0, 4.0)] * 2, st.floats(-3.0, 3.0)),
    root=st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9),
)
@settings(deadline=None, max_examples=25)
def test_one_step_is_the_dense_form(estimate, truth, root):
    """``e^T Sigma^-1 e / 3`` with the matrix logarithm and a dense solve."""
    L = np.reshape(root, (3, 3))
    covariance = L @ L.T + 1e-3 * np.eye(3)
    twist = np.real(logm(np.linalg.inv(matrix(estimate)) @ matrix(truth)))
    if abs(abs(twist[1, 0]) - np.pi) < 1e-3:
        return  # half a turn has two logarithms
    e = np.array([twist[0, 2], twist[1, 2], twist[1, 0]])
    found = pose_calibration(np.array([estimate]), covariance[None], np.array([truth]))
    expected = e @ np.linalg.solve(covariance, e)
    assert found["nees"] == pytest.approx(expected / 3.0, rel=1e-6, abs=1e-9)
    assert found["in_95"] == float(expected <= chi2.ppf(0.95, 3))


@pytest.mark.parametrize("factor", [1.0, 0.1])
def test_the_nees_of_errors_drawn_from_the_stated_covariance_is_one(factor):
    """And ten where the stated covariance is a tenth of the right one; the share inside is the chi-square's."""
    rng, rows = np.random.default_rng(3), []
    for _ in range(60):
        estimates, truth = drawn(rng, 40)
        rows.append(pose_calibration(estimates, np.tile(factor * COVARIANCE, (40, 1, 1)), truth))
    nees = bootstrap_mean([row["nees"] for row in rows], range(len(rows)))
    share = bootstrap_mean([row["in_95"] for row in rows], range(len(rows)))
    assert nees.low < 1.0 / factor < nees.high
    assert nees.high - nees.low < 0.15 / factor
    assert share.low < chi2.cdf(factor * chi2.ppf(0.95, 3), 3) < share.high


def test_a_known_pose_that_is_exact_has_no_error_and_one_that_is_wrong_a_finite_large_one():
    pose, zero = np.array([[3.0, -2.0, 0.7]]), np.zeros((1, 3, 3))
    rounded = pose.astype(np.float32).astype(np.float64)
    exact = pose_calibration(pose, zero, rounded)
    assert exact["nees"] < 1.0
    assert exact["in_95"] == 1.0
    wrong = pose_calibration(pose, zero, np.add(pose, [0.01, 0.0, 0.0]))
    assert wrong["nees"] == pytest.approx((0.01 / RESOLUTION) ** 2 / 3.0, rel=1e-6)
    assert wrong["in_95"] == 0.0


def test_a_direction_without_variance_counts_like_the_others():
    """A robot that cannot move sideways: an error forward is as large as stated, one to the left cannot be."""
    covariance = np.diag([0.01, 0.0, 0.01])[None]
    pose = np.array([[1.0, 1.0, np.pi / 2]])  # forward is y, left is -x
    forward = pose_calibration(pose, covariance, np.add(pose, [0.0, 0.1, 0.0]))
    left = pose_calibration(pose, covariance, np.add(pose, [-0.1, 0.0, 0.0]))
    assert forward["nees"] == pytest.approx(1.0 / 3.0, rel=1e-6)
    assert 1e4 < left["nees"] < np.inf


def test_an_episode_is_the_mean_over_its_steps_and_nothing_without_steps():
    estimates, covariances = np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 0.0, 0.0]])
    assert pose_calibration(estimates, covariances, truth) == {"nees": pytest.approx(14.0 / 12.0), "in_95": 0.75}
    nothing = pose_calibration(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert nothing == {"nees": None, "in_95": None}


def test_the_region_holds_its_probability():
    edge = chi2.ppf(0.95, 6)
    assert inside_region(np.array([edge - 1e-9, edge + 1e-9]), 6).tolist() == [True, False]
