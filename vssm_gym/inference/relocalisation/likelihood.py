"""Compare an image with all panoramas at all headings: ``log p(x | place, heading)`` up to a constant.

    -log p = sum_ij  min(|log r - log r*| / s_r, 3) + mean_c min(|log c - log c* - g| / s_c, 3),   s_r = s_0 + d / r

over the cells of the cylinder (eq. I43), with a constant price for what only one of the two shows. ``d`` is how far the
camera may be from the nearest place, and ``g`` the camera's gain, the mean difference of the logarithms. The sums along
headings are vectorised: one slice of the stored panoramas holds what one column of the image meets at every heading.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.ring_costs import accumulate
from vssm_gym.inference.relocalisation.cylinder import Cylinder, Ring
from vssm_gym.inference.relocalisation.panoramas import Panoramas


@dataclass(frozen=True)
class ComparisonConfig:
    """Configure scales of the comparison, in logarithms, and which of its maxima are candidates."""

    log_range: float = 0.04  # s_0
    offset: float = 0.1  # m, d: about 0.4 of the spacing of places
    log_colour: float = 0.25  # s_c
    limit: float = 3.0  # in scales, of a residual
    unseen: float = 1.8  # in scales, of a cell that only one of the two shows
    most_gain: float = 0.3  # largest |g|
    candidates: int = 24
    apart: float = 0.3  # m: candidates that are nearer and
    apart_heading: float = 0.18  # rad: nearer than this are one


def compare(
    image: Ring, panoramas: Panoramas, cylinder: Cylinder, config: ComparisonConfig
) -> Float[np.ndarray, "places headings"]:
    """Return the log likelihood of an image at every place and heading, per cell; column k is the heading k * step."""
    ring, columns = panoramas.ring, cylinder.config.columns
    scale = config.log_range + config.offset / np.maximum(np.exp(image.log_range), 0.3)
    weights = (image.read / scale).astype(np.float32)
    starts = (cylinder.first + np.arange(cylinder.columns)) % columns
    cost = np.zeros((len(panoramas.places), columns), np.float32)
    scales = np.array([1.0 / config.log_colour, config.limit, config.unseen, config.most_gain], np.float32)
    accumulate(*image, weights, starts, *ring[:3], scales, cost)
    return -cost / max(float(image.seen.sum()), 1.0)


def peaks(
    scores: Float[np.ndarray, "n headings"], places: Float[np.ndarray, "n 2"], step: float, config: ComparisonConfig
) -> list[tuple[int, int]]:
    """Return the best ``(place, heading)`` that are apart, best first."""
    columns = scores.shape[1]
    reach = math.floor(config.apart_heading / step)
    left, found = scores.copy(), []
    for _ in range(config.candidates):
        place, heading = divmod(int(np.argmax(left)), columns)
        if not np.isfinite(left[place, heading]):
            break
        found.append((place, heading))
        near = np.hypot(*(places - places[place]).T) < config.apart
        window = (heading + np.arange(-reach, reach + 1)) % columns
        left[np.ix_(near, window)] = -np.inf
    return found
