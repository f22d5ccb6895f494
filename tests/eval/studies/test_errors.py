"""Test the summary of errors and covariances on a filter whose answer is known: a Kalman filter."""

import numpy as np
import pytest
from scipy.stats import chi2

from vssm_gym.eval.studies.calibration.errors import FilterErrors, RunErrors, summarise

PROCESS, MEASUREMENT = 0.1**2, 0.2**2  # variances of a step and of a measurement of a random walk in three dimensions


def kalman_run(rng: np.random.Generator, frames: int, factor: float) -> FilterErrors:
    """Filter a random walk from a known start; the stated covariance is ``factor`` times the right one."""
    x, mean, variance = np.zeros(3), np.zeros(3), 0.0
    residuals, covariances = [], []
    for _ in range(frames):
        x = x + rng.normal(size=3) * PROCESS**0.5
        variance += PROCESS
        gain = variance / (variance + MEASUREMENT)
        mean = mean + gain * (x + rng.normal(size=3) * MEASUREMENT**0.5 - mean)
        variance *= 1.0 - gain
        residuals.append(x - mean)
        covariances.append(factor * variance * np.eye(3))
    return FilterErrors(np.array(residuals), np.array(covariances), frames, 0, True)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_nees_of_a_linear_gaussian_filter(factor: float) -> None:
    """It is 1 for the right covariance, 2 for half of it and 1/2 for double; so are the segments' ends."""
    rng = np.random.default_rng(0)
    runs = []
    for _ in range(60):
        ends = tuple(kalman_run(rng, 20, factor).last_nees for _ in range(5))
        runs.append(RunErrors(kalman_run(rng, 100, factor), ends))
    row = summarise(runs)
    assert row["nees"]["mean"] == pytest.approx(1.0 / factor, rel=0.05)
    assert row["nees"]["low"] < 1.0 / factor < row["nees"]["high"]
    assert row["nees"]["high"] - row["nees"]["low"] < 0.2 / factor
    assert row["segments"]["mean"] == pytest.approx(1.0 / factor, rel=0.15)
    inside = chi2.cdf(factor * chi2.ppf(0.95, 3), 3)
    assert row["segments"]["low"] < inside < row["segments"]["high"]
    assert row["error_m"] / row["std_m"] == pytest.approx(factor**-0.5, rel=0.03)  # of x and y of a robot on a floor
    assert (row["runs"], row["frames"], row["segments"]["count"]) == (60, 6000, 300)


def test_the_location_has_two_coordinates_on_the_floor_and_three_in_space() -> None:
    planar = FilterErrors(np.array([[3.0, 4.0, 9.0]]), np.diag([4.0, 5.0, 7.0])[None], 1, 0, True)
    row = summarise([RunErrors(planar, ())])
    assert (row["error_m"], row["std_m"], row["dimension"]) == (5.0, 3.0, 3)
    errors = FilterErrors(np.array([[3.0, 0.0, 4.0, 9.0, 9.0, 9.0]]), np.diag([4.0, 4, 1, 7, 7, 7])[None], 1, 0, True)
    row = summarise([RunErrors(errors, ())])
    assert (row["error_m"], row["std_m"], row["dimension"]) == (5.0, 3.0, 6)
    assert row["nees"]["low"] is None  # one run has no interval
    assert row["segments"]["share"] is None


def test_lost_frames_and_segments_are_counted_and_left_out() -> None:
    lost = FilterErrors(np.zeros((0, 3)), np.zeros((0, 3, 3)), 5, 5, False)
    good = FilterErrors(np.ones((4, 3)), np.tile(np.eye(3), (4, 1, 1)), 5, 1, False)
    assert good.last_nees is None
    row = summarise([RunErrors(lost, (None, None)), RunErrors(good, (3.0, None))])
    assert (row["runs"], row["frames"], row["lost"]) == (2, 10, 6)
    assert row["nees"]["values"] == [1.0]
    assert (row["segments"]["count"], row["segments"]["ended_lost"], row["segments"]["share"]) == (1, 3, 1.0)
    nothing = summarise([RunErrors(lost, (None,))])
    assert nothing["nees"]["mean"] is nothing["error_m"] is nothing["segments"]["share"] is None


def test_the_velocity_counts_components_within_two_stds() -> None:
    velocity = np.array([[0.0, 1.9, 2.0, 3.0, -3.0, -1.0]])
    errors = FilterErrors(np.ones((1, 6)), np.eye(6)[None], 1, 0, True, velocity)
    assert summarise([RunErrors(errors, ())])["velocity"] == {
        "linear": pytest.approx(2 / 3),
        "angular": pytest.approx(1 / 3),
    }
