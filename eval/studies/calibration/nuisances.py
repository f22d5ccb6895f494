"""Estimate two errors of a recording's ground truth: the delay of its clock, and the error of its first pose.

    e_i(delay, delta) = log(T_est_i^-1 A T_true(t_i + delay)),   A = T_est_0 (T_true(t_0 + delay) exp(delta))^-1
    (delay, delta) = argmin sum_i e_i^T Sigma_i^-1 e_i

A motion-capture system and a camera have clocks of their own, and the one pose that aligns both trajectories has an
error that turns all others. Both are nuisances: they are no errors of the filter. Estimates of seven numbers
from errors that are correlated over time take up a part of the filter's drift, too; the NEES after it is a lower bound.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from vssm_gym.eval.studies.calibration.recordings import Estimates, errors_of
from vssm_gym.slam.calibration import whiten

LARGEST_DELAY = 0.5  # s
SCALE = 0.01  # s, m and rad: about the size of a nuisance


@dataclass(frozen=True)
class Nuisances:
    """Hold estimated errors of the ground truth."""

    delay: float  # s, of its clock against the images'
    delta: Float[np.ndarray, "6"]  # of its first pose: translation (m), rotation (rad)

    @property
    def first_pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the true first pose in the frame of the recorded one."""
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = self.delta[:3], Rotation.from_rotvec(self.delta[3:]).as_matrix()
        return T


def fit(given: Estimates, *, delay: bool, first_pose: bool) -> Nuisances:
    """Fit the nuisances that are asked for by least squares of the whitened residuals; the others are zero.

    Raises:
        InputError: no tracked frames with a ground-truth pose.
    """
    free = np.array([delay] + [first_pose] * 6)

    def nuisances(x: np.ndarray) -> Nuisances:
        values = np.zeros(7)
        values[free] = SCALE * x
        return Nuisances(float(values[0]), values[1:])

    def residuals(x: np.ndarray) -> np.ndarray:
        at = nuisances(x)
        found = errors_of(given, at.delay, at.first_pose)
        return whiten(found.residuals, found.covariances).ravel()

    bound = np.array([LARGEST_DELAY] + [np.inf] * 6)[free] / SCALE
    solved = least_squares(residuals, np.zeros(free.sum()), jac="3-point", bounds=(-bound, bound))
    return nuisances(solved.x)
