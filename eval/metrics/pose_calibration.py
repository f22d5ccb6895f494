"""Judge the covariances that an agent states for its poses: NEES, and the share of steps inside the 95 % region.

    e_t = log(T_est_t^-1 T_true_t),   NEES_t = e_t^T Sigma_t^-1 e_t ~ chi^2(d) where Sigma_t is right,   d = 3

An episode's ``nees`` is the mean over its steps divided by d: 1 where the covariances are right, above 1 where they are
too small. Steps of one episode are correlated, so an interval is over episodes, never over steps.

A covariance may be singular: a robot knows its start, or its model leaves no error in a direction. Its eigenvalues are
then raised to the least that a pose and a covariance in single precision can mean, so that an exact estimate has a NEES
near 0, and an error in a direction that was stated as known a very large one. The first step, whose pose every agent is
given, does not count.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.slam.calibration import nees, pose_residuals

REGION = 0.95  # probability of the region whose coverage is counted
RESOLUTION = 1e-6  # m, rad: rounding of a coordinate of some metres in single precision
AXES = np.flatnonzero(PLANAR.twists.any(axis=1))  # coordinates of a twist that a body on the floor has


def inside_region(values: Float[np.ndarray, "n"], dimension: int) -> Bool[np.ndarray, "n"]:
    """Return which errors lie inside their 95 % region, ``NEES <= chi^2_d(95 %)``."""
    return values <= chi2.ppf(REGION, dimension)


def planar_residuals(estimates: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """``log(T_est^-1 T_true)``: forward, left (m) and turn (rad) in the estimate's frame, from ``(x, y, heading)``."""
    T_est, T_true = (planar_to_matrix(np.asarray(poses, np.float64)) for poses in (estimates, truth))
    return pose_residuals(T_est, T_true)[:, AXES]


def regular(covariances: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "n d d"]:
    """Raise eigenvalues that are 0 in single precision: below ``RESOLUTION``^2, or 1e-7 of the largest one."""
    values, axes = np.linalg.eigh(np.asarray(covariances, np.float64))
    least = np.maximum(RESOLUTION**2, np.finfo(np.float32).eps * values[:, -1:])
    return (axes * np.maximum(values, least)[:, None, :]) @ np.swapaxes(axes, 1, 2)


def pose_calibration(
    estimates: Float[np.ndarray, "n 3"], covariances: Float[np.ndarray, "n 3 3"], truth: Float[np.ndarray, "n 3"]
) -> dict[str, float | None]:
    """Compute ``nees`` (mean over the steps, divided by d) and ``in_95`` (share of the steps) of one episode.

    Args:
        estimates: poses ``(x, y, heading)``, m and rad, of the steps that count.
        covariances: of (forward, left, turn) in the estimate's body frame, m^2 and rad^2; perhaps singular.
        truth: true poses at the same times.

    Returns:
        The fields of a row; None where no step counts.
    """
    if not len(estimates):
        return {"nees": None, "in_95": None}
    errors = planar_residuals(estimates, truth)
    values, dimension = nees(errors, regular(covariances)), errors.shape[1]
    return {"nees": float(values.mean()) / dimension, "in_95": float(inside_region(values, dimension).mean())}
