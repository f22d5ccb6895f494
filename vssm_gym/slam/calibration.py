"""Measure the calibration of covariances: whitened residuals, NEES, the chi-square calibration curve (thesis, A.2 H).

    e_i = log(T_est_i^-1 T_true_i)  in the tangent of the estimate, order (translation, rotation)
    w_i = L_i^-1 e_i,  L_i L_i^T = Sigma_i;   NEES_i = e_i^T Sigma_i^-1 e_i = |w_i|^2  ~  chi^2(d)  if calibrated

A residual in the body's tangent, and its covariance, do not change when both trajectories are moved rigidly; an
estimate may therefore be aligned before. The curve plots the observed share of residuals up to a size against the
probability that the model gives to it: above the diagonal the model is pessimistic, below it overconfident (Jospin et
al., "Hands-on Bayesian neural networks", 2022, section VII).

One global scale of all covariances makes the mean NEES equal to d. What is left of the curve's distance from the
diagonal then shows whether relative uncertainties are right; the scale shows whether their absolute size is right.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse

NOMINAL_LEVELS = (0.5, 0.9, 0.95, 0.99)  # probabilities of the regions whose coverage is measured


def pose_residuals(T_est: Float[np.ndarray, "n 4 4"], T_true: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6"]:
    """``log(T_est^-1 T_true)``: translation (m), then rotation (rad), in the estimate's own frame; float64."""
    T = inverse(np.asarray(T_est, dtype=np.float64)) @ np.asarray(T_true, dtype=np.float64)
    w = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    theta = np.linalg.norm(w, axis=1, keepdims=True)
    near = theta < 1e-3
    safe = np.where(near, 1.0, theta)
    # V^-1 = 1 - w^/2 + c w^ w^, c = (1 - (theta/2) cot(theta/2)) / theta^2
    c = np.where(near, 1.0 / 12.0 + theta**2 / 720.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    w_t = np.cross(w, T[:, :3, 3])
    return np.concatenate([T[:, :3, 3] - 0.5 * w_t + c * np.cross(w, w_t), w], axis=1)


def whiten(residuals: Float[np.ndarray, "n d"], covariances: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "n d"]:
    """``L_i^-1 e_i``: residuals that are standard normal where the covariances are right.

    Raises:
        InputError: a covariance that is not finite or not positive definite.
    """
    e, S = np.asarray(residuals, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    # Units and magnitudes differ: scale to unit diagonal first, so that the factorisation is accurate in float64.
    variance = np.einsum("nii->ni", S)
    try:
        if not (np.isfinite(S).all() and np.isfinite(e).all() and (variance > 0.0).all()):
            raise np.linalg.LinAlgError
        std = np.sqrt(variance)
        L = np.linalg.cholesky(S / (std[:, :, None] * std[:, None, :]))
    except np.linalg.LinAlgError:
        raise InputError("calibration", "covariances", "finite residuals, positive definite covariances") from None
    return np.linalg.solve(L, (e / std)[..., None])[..., 0]


def nees(residuals: Float[np.ndarray, "n d"], covariances: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "n"]:
    """``e^T Sigma^-1 e``: the normalised estimation error squared; its expectation is d."""
    return np.sum(whiten(residuals, covariances) ** 2, axis=1)


@dataclass(frozen=True)
class Calibration:
    """Compare one sequence's residuals with their covariances."""

    whitened: Float[np.ndarray, "n d"]

    @classmethod
    def of(cls, residuals: Float[np.ndarray, "n d"], covariances: Float[np.ndarray, "n d d"]) -> "Calibration":
        """Make a calibration from residuals and their covariances, frame by frame."""
        return cls(whiten(residuals, covariances))

    @property
    def nees(self) -> Float[np.ndarray, "n"]:
        """Return the NEES of each frame."""
        return np.sum(self.whitened**2, axis=1)

    @property
    def dimension(self) -> int:
        """Return d, the degrees of freedom."""
        return self.whitened.shape[1]

    def scaled(self, factor: float) -> "Calibration":
        """Return the same residuals with every covariance multiplied by ``factor``."""
        return Calibration(self.whitened / np.sqrt(factor))

    def curve(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Return predicted and observed cumulative probability of each residual, in ascending order."""
        predicted = chi2.cdf(np.sort(self.nees), self.dimension)
        return predicted, np.arange(1, len(predicted) + 1) / len(predicted)

    def summary(self) -> dict[str, float]:
        """Summarise NEES and the calibration curve.

        Returns:
            ``nees`` (mean), ``nees_over_dimension``, ``share_within_50`` ... ``_99``: share of frames in the region of
            that probability; ``gap``: mean distance of the curve from the diagonal; ``bias``: the same with its sign,
            positive where the model is pessimistic.
        """
        predicted = chi2.cdf(self.nees, self.dimension)
        level = np.linspace(0.0, 1.0, 201)
        observed = np.searchsorted(np.sort(predicted), level, side="right") / len(predicted)
        result = {"nees": float(self.nees.mean()), "nees_over_dimension": float(self.nees.mean() / self.dimension)}
        result |= {f"share_within_{round(100 * p)}": float(np.mean(predicted <= p)) for p in NOMINAL_LEVELS}
        result["gap"] = float(np.mean(np.abs(observed - level)))
        result["bias"] = float(np.mean(observed - level))
        return result


def fit_scale(sequences: Mapping[str, Calibration]) -> float:
    """Fit the factor on all covariances that maximises the likelihood of all residuals: ``mean NEES / d``."""
    every = np.concatenate([c.nees / c.dimension for c in sequences.values()]) if sequences else np.zeros(0)
    if len(every) == 0:
        raise InputError("calibration", "sequences", "at least one frame to fit the covariances' scale to")
    return float(every.mean())


def segments(times: Float[np.ndarray, "n"], seconds: float) -> list[slice]:
    """Cut a run into consecutive segments that share no frame; a rest that is shorter than a segment is left out.

    Args:
        times: of the frames, s, ascending; at least two.
        seconds: length of a segment; the last frame lasts as long as the median frame.

    Returns:
        The frames of each segment; those without two frames are left out.
    """
    since, slack = np.asarray(times, np.float64) - times[0], 1e-6  # s: stamps are rounded to microseconds
    whole = int((since[-1] + np.median(np.diff(since)) + slack) / seconds)
    starts = np.searchsorted(since, seconds * np.arange(whole + 1) - slack).tolist()
    return [slice(first, last) for first, last in pairwise(starts) if last - first >= 2]
