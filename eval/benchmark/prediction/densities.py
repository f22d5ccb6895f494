"""Estimate what a predicted density of an image integrates to: a score in nats is worth nothing where it is not 1.

    P(no reading) + int p(d) dd,   int p(c | d) dc,   each by importance sampling about the image that was taken

Half of the draws are uniform, the others at a distance from the image's own value that is uniform in its logarithm, so
that narrow and wide densities are both met. The estimate is unbiased for every density. A narrow one far from the image
is rarely met, so that a single estimate of it is mostly too small, which accuses no model.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from vssm_gym.eval.bench.prediction.contract import ImagePrediction
from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD

DRAWS = 24  # of each pixel
NEAREST_DEPTH, NEAREST_COLOUR = 1e-4, 1e-3  # m, and share of the range: the least distance of a draw from the image
MOST_MASS = 1.5  # beyond all errors of the estimate, and 0.4 nats


def masses(prediction: ImagePrediction, image: RGBD, rng: np.random.Generator) -> tuple[float, float]:
    """Return what depth with its absence, and colour given a reading, integrate to, each as a mean over the pixels.

    Args:
        prediction: of an image.
        image: that was taken.
        rng: of the draws.
    """
    depth, rgb = np.asarray(image.depth, float), np.asarray(image.rgb, float)
    read = depth > 0.0
    depth_mass = np.exp(_log_p(prediction, np.zeros_like(depth), rgb)[0])
    rgb_mass = np.zeros_like(depth)
    for _ in range(DRAWS):
        d, density = _depths(np.where(read, depth, 0.5 * MAX_DEPTH), rng)
        within = (d > 0.0) & (d <= MAX_DEPTH)
        log_p, _ = _log_p(prediction, np.where(within, d, 1.0), rgb)
        depth_mass += np.where(within, np.exp(log_p) / density, 0.0) / DRAWS
        c, density = _colours(rgb, rng)
        inside = ((c >= 0.0) & (c <= 1.0)).all(axis=-1)
        _, log_p = _log_p(prediction, np.where(read, depth, 1.0), np.clip(c, 0.0, 1.0))
        rgb_mass += np.where(inside, np.exp(log_p) / density, 0.0) / DRAWS
    return float(depth_mass.mean()), float(rgb_mass.mean())


def _log_p(prediction: ImagePrediction, depth: np.ndarray, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log density of depth, and of colour given a reading, of each pixel."""
    read = jnp.asarray(depth > 0.0)
    image = RGBD(jnp.asarray(depth, jnp.float32), jnp.asarray(rgb, jnp.float32), read, read)
    found: Any = prediction.image_log_prob(image)
    return np.asarray(found.depth, float), np.asarray(found.rgb, float)


def _depths(middle: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw depths about some and uniform ones; return them and their density, 1/m."""
    spread = math.log(MAX_DEPTH / NEAREST_DEPTH)
    away = NEAREST_DEPTH * np.exp(spread * rng.random(middle.shape)) * rng.choice([-1.0, 1.0], middle.shape)
    uniform = MAX_DEPTH * (1.0 - rng.random(middle.shape))
    d = np.where(rng.random(middle.shape) < 0.5, middle + away, uniform)
    distance = np.abs(d - middle)
    near = (distance >= NEAREST_DEPTH) & (distance <= MAX_DEPTH)
    about = np.where(near, 1.0 / (2.0 * spread * np.maximum(distance, NEAREST_DEPTH)), 0.0)
    return d, 0.5 * about + 0.5 * ((d > 0.0) & (d <= MAX_DEPTH)) / MAX_DEPTH


def _colours(middle: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw colours about some and uniform ones; return them and their density."""
    shape, spread = middle.shape[:-1], math.log(1.0 / NEAREST_COLOUR)
    away = NEAREST_COLOUR * np.exp(spread * rng.random(shape))
    direction = rng.normal(size=middle.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    c = np.where((rng.random(shape) < 0.5)[..., None], middle + away[..., None] * direction, rng.random(middle.shape))
    distance = np.linalg.norm(c - middle, axis=-1)
    near = (distance >= NEAREST_COLOUR) & (distance <= 1.0)
    about = np.where(near, 1.0 / (4.0 * math.pi * spread * np.maximum(distance, NEAREST_COLOUR) ** 3), 0.0)
    return c, 0.5 * about + 0.5 * ((c >= 0.0) & (c <= 1.0)).all(axis=-1)
