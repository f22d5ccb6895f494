"""Compute the emission's density in float64 with SciPy, written from its definition and not from the code."""

import numpy as np
from scipy import stats

from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission_density import EmissionScales

KNOWN, GUESSED, EMPTY = range(3)  # what the map predicts at a pixel: an observed surface, another one, none


def shares(kind: np.ndarray, scales: EmissionScales) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the probability of no reading, and the shares of outliers of depth and colour, by kind of pixel."""
    misses = np.array([scales.miss, scales.guess_miss, scales.empty_miss], float)
    outliers = np.array([scales.outlier, scales.guess_outlier, 1.0], float)
    rgb_outliers = np.array([scales.rgb_outlier, scales.guess_rgb_outlier, 1.0], float)
    return misses[kind], outliers[kind], rgb_outliers[kind]


def truncated(x: np.ndarray, location: np.ndarray, scale: np.ndarray | float, end: float) -> np.ndarray:
    """Return the Laplace density renormalised on ``[0, end]``."""
    mass = stats.laplace.cdf(end, location, scale) - stats.laplace.cdf(0.0, location, scale)
    return stats.laplace.pdf(x, location, scale) / mass


def pixel_log_prob(
    depth: np.ndarray,
    rgb: np.ndarray,
    predicted_depth: np.ndarray,
    predicted_rgb: np.ndarray,
    kind: np.ndarray,
    scales: EmissionScales,
    max_depth: float = MAX_DEPTH,
    depth_std: float = 0.0,
    rgb_std: float = 0.0,
) -> np.ndarray:
    """Return the log density of each pixel ``(n,)``; a depth of 0 is no reading."""
    miss, outlier, rgb_outlier = shares(np.asarray(kind), scales)
    std = np.where(np.asarray(kind) == KNOWN, 1.0, 0.0)
    scale = np.hypot(float(scales.depth) + float(scales.growth) * predicted_depth**2, std * depth_std / np.sqrt(2.0))
    rgb_scale = np.hypot(float(scales.rgb), std * rgb_std / np.sqrt(2.0))[:, None]
    of_depth = (1 - outlier) * truncated(depth, predicted_depth, scale, max_depth) + outlier / max_depth
    of_rgb = (1 - rgb_outlier) * truncated(rgb, predicted_rgb, rgb_scale, 1.0).prod(-1) + rgb_outlier
    with np.errstate(divide="ignore"):
        return np.where(depth > 0.0, np.log((1 - miss) * of_depth * of_rgb), np.log(miss))
