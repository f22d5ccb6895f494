"""Score a predicted image by the probability of what a camera can say: no reading, or a level of depth and of colour.

    no reading   log P(none)
    a reading    log [P(reading) P(depth in its bin) / width] + sum_c log [P(channel at its grey level) / width]
    P            (1 - e) P_model + e P_uninformed,   e = 1 %

A camera rounds: colours to 256 grey levels, depth to steps of its disparity. A density can therefore be raised without
limit by peaks at these values, which are all that a camera says; a probability can not. Divided by the width of its bin
it is the mean density there, in nats with respect to metres and to units of colour, and 0 for a colour by who knows
nothing. The bins of depth are the camera's own steps, as many together as a centimetre needs. A model is asked for its
distribution functions at the edges of all bins, so that the question does not tell the answer, and what it says is
checked: between 0 and 1, and nowhere falling. Channels count by their marginal distributions, as a prediction has no
function of all three together. Every prediction is mixed with a share of who knows nothing, so that a value that was
held to be impossible costs a finite number of nats.
"""

from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.sensors.rgbd_noise import PRESETS
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.contract import ImagePrediction
from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import has_reading

LEAST_BIN = 0.01  # m, width of a bin of depth
GREY_LEVELS = 256  # of a channel
IGNORANT = 0.01  # share of who knows nothing in every prediction
EITHER = 0.5  # probability of a reading by who knows nothing
UNINFORMED = float(np.log(EITHER) - np.log(MAX_DEPTH))  # nats of a pixel with a reading by who knows nothing
SINGLE_ROUNDING = 1e-3  # by which single precision may miss 0, 1 and the value before


def nats(prediction: ImagePrediction, image: RGBD, sensor_noise: str) -> Float[np.ndarray, "pixels"]:
    """Return the score of each pixel.

    Args:
        prediction: of an image.
        image: that was taken.
        sensor_noise: of the camera.

    Raises:
        InputError: distribution functions or probabilities that are none.
    """
    read = np.asarray(has_reading(image))
    none = _nothing(prediction, read.shape)
    of_depth, of_grey = depth_edges(sensor_noise), grey_edges()
    depth, rgb = np.asarray(image.depth, float), np.asarray(image.rgb, float)
    p, width = _at(prediction.depth_cdf, of_depth, np.where(read, depth, 0.5 * MAX_DEPTH), "depth_cdf")
    given = (1.0 - IGNORANT) * (1.0 - none) * p / width + IGNORANT * EITHER / MAX_DEPTH
    nothing = (1.0 - IGNORANT) * none + IGNORANT * (1.0 - EITHER)
    p, width = _at(prediction.rgb_cdf, of_grey, rgb, "rgb_cdf")
    colour = np.log((1.0 - IGNORANT) * p / width + IGNORANT).sum(axis=-1)
    return np.where(read, np.log(given) + colour, np.log(nothing)).ravel()


@cache
def depth_edges(sensor_noise: str) -> Float[np.ndarray, "edges"]:
    """Return the edges of the bins of depth from 0 to MAX_DEPTH, m; each holds whole steps of the disparity."""
    noise = PRESETS[sensor_noise]
    if noise.disparity_step == 0.0:
        return np.linspace(0.0, MAX_DEPTH, round(MAX_DEPTH / LEAST_BIN) + 1)
    step = noise.disparity_step / noise.baseline  # 1/m
    halves = np.arange(int(1.0 / (step * MAX_DEPTH)), int(1.0 / (step * LEAST_BIN)))[::-1] + 0.5
    edges = [0.0]
    for edge in 1.0 / (step * halves):
        if edge - edges[-1] >= LEAST_BIN and MAX_DEPTH - edge >= LEAST_BIN:
            edges.append(float(edge))
    return np.array([*edges, MAX_DEPTH])


@cache
def grey_edges() -> Float[np.ndarray, "edges"]:
    """Return the edges of the grey levels: each stands for all light that is rounded to it."""
    most = GREY_LEVELS - 1
    return np.array([0.0, *(np.arange(most) + 0.5) / most, 1.0])


def _nothing(prediction: ImagePrediction, shape: tuple[int, ...]) -> np.ndarray:
    """Return the probability of no reading by pixel."""
    nowhere = jnp.zeros(shape, bool)
    empty = RGBD(jnp.zeros(shape, jnp.float32), jnp.zeros((*shape, 3), jnp.float32), nowhere, nowhere)
    found: Any = prediction.image_log_prob(empty)
    p = np.exp(np.asarray(found.depth, float))
    if p.shape != shape or not np.all((p >= 0.0) & (p <= 1.0 + SINGLE_ROUNDING)):
        worst = np.max(p, initial=0.0, where=np.isfinite(p))
        raise InputError(
            "prediction", "image_log_prob", f"a probability of no reading by pixel; found up to {worst:.3g}"
        )
    return np.minimum(p, 1.0)


def _at(cdf: Any, edges: np.ndarray, value: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the probability of the bin of each value, and the bin's width."""
    asked = jnp.asarray(np.broadcast_to(edges.reshape(-1, *[1] * value.ndim), (len(edges), *value.shape)), jnp.float32)
    below = np.asarray(cdf(asked), float)
    rises = np.diff(below, axis=0) if below.shape == asked.shape else np.array(np.nan)
    if not (
        np.all(rises >= -SINGLE_ROUNDING) and np.all((below >= -SINGLE_ROUNDING) & (below <= 1.0 + SINGLE_ROUNDING))
    ):
        expected = f"a distribution function by pixel {asked.shape}, from 0 to 1 and nowhere falling"
        raise InputError("prediction", name, f"{expected}; found {_range(below)}")
    number = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
    return np.clip(np.take_along_axis(rises, number[None], axis=0)[0], 0.0, 1.0), np.diff(edges)[number]


def _range(values: np.ndarray) -> str:
    """Return the least and the largest value in words, with the shape."""
    if not values.size or not np.isfinite(values).all():
        return f"{values.shape} with values that are not finite"
    return (
        f"{values.shape} from {values.min():.3g} to {values.max():.3g}, falling by {-np.diff(values, axis=0).min():.3g}"
    )
