"""Test errors of a recording's estimates, and the nuisances of its ground truth, on estimates made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from vssm_gym.errors import InputError
from vssm_gym.eval.studies.calibration import nuisances
from vssm_gym.eval.studies.calibration.recordings import Estimates, errors_of, last_nees


def tangent(delta: np.ndarray) -> np.ndarray:
    v, w = delta[:3], delta[3:]
    return expm(np.array([[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0.0]]))


def calibrated(frames: int, scale: float = 1.0) -> Estimates:
    """Draw errors of poses and velocities from covariances that are then stated ``scale`` times too small.

    The truth lives in a world of its own, as a motion capture system's does.
    """
    rng = np.random.default_rng(0)
    T_world_first = tangent(rng.normal(size=6))
    times, truth, velocity = 0.1 * np.arange(frames), [np.eye(4)], [np.zeros(6)]
    for _ in times[1:]:
        v = 0.5 * rng.normal(size=6)  # R' = exp(w dt) R, t' = t + v dt
        T = tangent(np.array([0, 0, 0, *(0.1 * v[3:])])) @ truth[-1]
        T[:3, 3] = truth[-1][:3, 3] + 0.1 * v[:3]
        truth.append(T)
        velocity.append(v)
    poses, speeds, covariances = [np.eye(4)], [np.full(6, np.nan)], [np.full((12, 12), np.nan)]
    for i in range(1, frames):
        A = rng.normal(size=(12, 12)) * 10.0 ** rng.uniform(-4, -2, (12, 1))
        e = A @ rng.normal(size=12)
        poses.append(truth[i] @ tangent(e[:6]))
        speeds.append(velocity[i] + e[6:])
        covariances.append(A @ A.T / scale)
    return Estimates(
        times,
        np.array(poses),
        np.array(speeds),
        np.array(covariances),
        np.ones(frames, bool),
        (times, T_world_first @ np.stack(truth)),
    )


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_a_calibrated_filter_has_an_nees_of_one_per_dimension(scale: float) -> None:
    """NEES / 6 and the velocity's RMS equal those that were drawn, in any world frame of the truth."""
    errors = errors_of(calibrated(600, scale))
    assert errors.nees.mean() / 6 == pytest.approx(scale, rel=0.05)
    np.testing.assert_allclose(np.sqrt(np.mean(errors.velocity**2)), np.sqrt(scale), rtol=0.03)
    assert errors.nees.shape == (599,)  # the first frame claims nothing
    assert (errors.frames, errors.lost, errors.ended) == (599, 0, True)


def test_lost_frames_and_frames_without_truth_are_left_out() -> None:
    run = calibrated(20)
    times, truth = run.truth
    accepted, poses = run.accepted.copy(), run.T_world_cam.copy()
    accepted[7] = False
    poses[7, 0, 3] = 9.0
    holed = replace(
        run, accepted=accepted, T_world_cam=poses, truth=(np.delete(times, 12), np.delete(truth, 12, axis=0))
    )
    errors = errors_of(holed)
    assert (errors.frames, errors.lost, len(errors.nees)) == (19, 1, 17)
    assert len(errors.velocity) == 16  # frame 13 follows one whose true pose is not known
    assert np.linalg.norm(errors.residuals[:, :3], axis=1).max() < 0.5
    accepted[19] = False
    assert last_nees(replace(holed, accepted=accepted)) is None
    sparse = replace(run, truth=(times[[0, 5, 10]], truth[[0, 5, 10]]))
    with pytest.raises(InputError, match="frames"):
        errors_of(sparse)
    assert last_nees(sparse) is None


def smooth(delay: float, delta: np.ndarray) -> Estimates:
    """Return good estimates of a smooth motion, and a truth whose clock is late and whose first pose is off."""
    rng = np.random.default_rng(1)

    def motion(t: np.ndarray) -> np.ndarray:
        turns = np.stack([0.3 * np.sin(t), 0.2 * np.sin(1.7 * t), 0.4 * np.sin(0.6 * t)], axis=-1)
        places = np.stack([np.sin(0.5 * t), 0.5 * np.cos(t), 0.1 * t], axis=-1)
        return np.array([tangent(np.concatenate(pair)) for pair in zip(places, turns, strict=True)])

    times, stamps = 0.1 * np.arange(60), 0.02 * np.arange(-25, 325)
    right = motion(times)
    T_est = right @ np.array([np.eye(4)] + [tangent(1e-3 * rng.normal(size=6)) for _ in times[1:]])
    # The first recorded pose, at its own clock, is the right one times exp(-delta): undo it with exp(delta).
    recorded = motion(stamps - delay)
    first = np.argmin(np.abs(stamps - delay))  # of the poses around it, from which it is interpolated
    recorded[first - 1 : first + 2] = recorded[first - 1 : first + 2] @ tangent(-delta)
    covariance = np.tile(np.diag([1e-6] * 6 + [1.0] * 6), (len(times), 1, 1))
    velocity = np.zeros((len(times), 6))
    since = 1.3e9  # s, as stamps of real recordings are
    return Estimates(since + times, T_est, velocity, covariance, np.ones(len(times), bool), (since + stamps, recorded))


def test_a_known_delay_and_first_pose_are_recovered() -> None:
    """Only the first frame's true pose is wrong: it is that which turns all others."""
    delta = np.array([0.02, -0.01, 0.015, 0.01, -0.02, 0.005])
    given = smooth(0.03, delta)
    both = nuisances.fit(given, delay=True, first_pose=True)
    assert both.delay == pytest.approx(0.03, abs=1e-3)
    np.testing.assert_allclose(both.delta, delta, atol=2e-3)
    drawn = errors_of(given, 0.03, tangent(delta)).nees.mean() / 6
    assert drawn == pytest.approx(1.0, abs=0.3)
    fitted = errors_of(given, both.delay, both.first_pose).nees.mean() / 6
    assert 0.94 * drawn < fitted <= drawn  # least squares of seven numbers takes up a little of the noise
    assert errors_of(given).nees.mean() / 6 > 50.0
    alone = nuisances.fit(smooth(0.03, np.zeros(6)), delay=True, first_pose=False)
    assert alone.delay == pytest.approx(0.03, abs=1e-3)
    assert not alone.delta.any()
    pose = nuisances.fit(smooth(0.0, delta), delay=False, first_pose=True)
    assert pose.delay == 0.0
    np.testing.assert_allclose(pose.delta, delta, atol=2e-3)
    nothing = nuisances.fit(smooth(0.0, np.zeros(6)), delay=True, first_pose=True)
    assert abs(nothing.delay) < 1e-3
    assert np.abs(nothing.delta).max() < 2e-3
