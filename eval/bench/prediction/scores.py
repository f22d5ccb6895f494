"""Score a prediction: log-likelihood, CRPS and PIT of depth, colour and pose (Gneiting and Raftery, JASA 2007)."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.eval.bench.prediction.contract import ImagePrediction, Prediction
from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import has_reading
from vssm_gym.model.transition.manifold import PLANAR

NODES, DENSITY = 64, 8.0  # of the integral on each side; the first interval is 1/22,000 of the range
GREY_LEVEL = 1.0 / 255.0  # a colour value stands for all light that is rounded to it
BAND = (0.025, 0.975)  # central 95 % band


@dataclass(frozen=True)
class ImageScores:
    """Hold the scores of one predicted image.

    Attributes:
        depth_nats: log density of the reading's depth or absence, of every pixel.
        rgb_nats: log density of colour given a reading, of every pixel; 0 without a reading.
        depth_crps: m, of pixels with a reading.
        rgb_crps: mean over the channels, of the same pixels.
        depth_pit: of the same pixels.
        rgb_pit: of the same pixels and each channel, flat.
    """

    depth_nats: Float[np.ndarray, "pixels"]
    rgb_nats: Float[np.ndarray, "pixels"]
    depth_crps: Float[np.ndarray, "readings"]
    rgb_crps: Float[np.ndarray, "readings"]
    depth_pit: Float[np.ndarray, "readings"]
    rgb_pit: Float[np.ndarray, "values"]


@dataclass(frozen=True)
class Scores(ImageScores):
    """Hold the scores of one prediction of image and pose.

    Attributes:
        pose_nats: log density of the true pose.
        location_crps: mean over forward and left, m.
        heading_crps: rad.
        pose_pit: of forward, left and turn.
    """

    pose_nats: float
    location_crps: float
    heading_crps: float
    pose_pit: Float[np.ndarray, "3"]


def score(prediction: Prediction, image: RGBD, planar: Float[np.ndarray, "3"], rng: np.random.Generator) -> Scores:
    """Score a prediction against the image and the true pose.

    Args:
        prediction: of them.
        image: taken by the camera that the prediction is for.
        planar: true ``(x, y, heading)``, m and rad.
        rng: of the randomised PIT of colour, whose values are integers.
    """
    of_image = score_image(prediction, image, rng)
    errors, truth = _pose_errors(prediction.poses, jnp.asarray(planar, jnp.float32))
    pose_crps = [sample_crps(errors[:, axis], truth[axis]) for axis in range(3)]
    return Scores(
        **vars(of_image),
        pose_nats=float(prediction.pose_log_prob(jnp.asarray(planar, jnp.float32))),
        location_crps=float(np.mean(pose_crps[:2])),
        heading_crps=pose_crps[2],
        pose_pit=(np.sum(errors < truth, axis=0) + rng.random(3)) / (len(errors) + 1),
    )


def score_image(prediction: ImagePrediction, image: RGBD, rng: np.random.Generator) -> ImageScores:
    """Score the image of a prediction alone, whatever its poses are.

    Args:
        prediction: of the image.
        image: taken by the camera that the prediction is for.
        rng: of the randomised PIT of colour, whose values are integers.
    """
    log_p = prediction.image_log_prob(image)
    read = np.asarray(has_reading(image))
    depth_crps = crps(prediction.depth_cdf, image.depth, MAX_DEPTH)
    rgb_crps = crps(prediction.rgb_cdf, image.rgb, 1.0)
    below, above = (prediction.rgb_cdf(image.rgb + sign * GREY_LEVEL / 2) for sign in (-1, 1))
    low, high = np.asarray(below, float)[read], np.asarray(above, float)[read]
    return ImageScores(
        depth_nats=np.asarray(log_p.depth, float).ravel(),
        rgb_nats=np.asarray(log_p.rgb, float).ravel(),
        depth_crps=np.asarray(depth_crps, float)[read],
        rgb_crps=np.asarray(rgb_crps, float).mean(-1)[read],
        depth_pit=np.asarray(prediction.depth_cdf(image.depth), float)[read],
        rgb_pit=(low + rng.random(low.shape) * (high - low)).ravel(),
    )


def crps(cdf: Callable[[Array], Array], value: Array, end: float) -> Array:
    """``int_0^end (F(y) - [y >= value])^2 dy`` by the trapezoidal rule, on nodes that are dense around the value.

    Args:
        cdf: distribution function; takes values with a leading axis.
        value: in ``[0, end]``, any shape.
        end: of the range.
    """
    offset = end * jnp.expm1(jnp.linspace(0.0, DENSITY, NODES)) / np.expm1(DENSITY)
    offset = offset.reshape(-1, *[1] * value.ndim)
    total = jnp.zeros_like(value)
    for sign, step in ((-1.0, 0.0), (1.0, 1.0)):
        nodes = jnp.clip(value + sign * offset, 0.0, end)
        square = (cdf(nodes) - step) ** 2
        total += jnp.sum(0.5 * (square[1:] + square[:-1]) * jnp.abs(jnp.diff(nodes, axis=0)), axis=0)
    return total


def sample_crps(samples: Float[np.ndarray, "n"], value: float) -> float:
    """``E|X - value| - 1/2 E|X - X'|`` over the samples, without bias in the second term."""
    x, n = np.sort(np.asarray(samples, float)), len(samples)
    spread = 2.0 * np.sum((2.0 * np.arange(n) - n + 1.0) * x) / (n * (n - 1.0))
    return float(np.mean(np.abs(x - value)) - 0.5 * spread)


def band_share(pit: Float[np.ndarray, "n"]) -> float:
    """Return the share inside the central 95 % band."""
    return float(np.mean((pit >= BAND[0]) & (pit <= BAND[1])))


def histogram(pit: Float[np.ndarray, "n"], bins: int) -> Float[np.ndarray, "bins"]:
    """Return the shares of the bins over the uniform share: 1 everywhere where the prediction is calibrated."""
    return np.histogram(np.clip(pit, 0.0, 1.0), bins, (0.0, 1.0))[0] * bins / max(len(pit), 1)


@jax.jit
def _errors(poses: Array, planar: Array) -> tuple[Array, Array]:
    mean = jnp.append(poses[:, :2].mean(0), jnp.arctan2(jnp.sin(poses[:, 2]).mean(), jnp.cos(poses[:, 2]).mean()))
    return PLANAR.error(mean, poses), PLANAR.error(mean, planar)


def _pose_errors(poses: Array, planar: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return (forward, left, turn) of the samples and of the truth about the samples' mean."""
    errors, truth = _errors(poses, planar)
    return np.asarray(errors, float), np.asarray(truth, float)
