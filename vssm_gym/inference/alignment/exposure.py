"""Estimate exposure: ``x_map = g x``, the gain from an image's brightness to the map's (ours, beyond PRISM).

A camera adapts its gain, for example when it turns to a window. The gain is estimated as the ratio of mean luminances
over the pixels that map and image both show: means tolerate the blur of rendered images and small errors of the pose.
Images are compared with the map, and enter it, after multiplication by the gain, so that the map keeps one exposure.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.model.emission import RGBD

GAIN_LIMIT = 4.0  # the largest gain, and its inverse the least: darker or brighter images have lost their detail
LUMINANCE_OFFSET = 0.01  # luminance added to both means, so that the gain of a black image is finite


def gain(
    reference: Float[Array, "*pixels"], observed: Float[Array, "*pixels"], both: Bool[Array, "*pixels"]
) -> Float[Array, ""]:
    """``mean(reference) / mean(observed)`` of luminances in [0, 1] over the pixels seen in ``both``; 1 without any."""
    count = jnp.maximum(jnp.sum(both), 1)
    bright, dark = jnp.sum(reference * both) / count, jnp.sum(observed * both) / count
    return jnp.clip((bright + LUMINANCE_OFFSET) / (dark + LUMINANCE_OFFSET), 1.0 / GAIN_LIMIT, GAIN_LIMIT)


def expose(image: RGBD, g: Float[Array, ""]) -> RGBD:
    """Return the image at another exposure, saturated at white (eq. I13)."""
    return eqx.tree_at(lambda i: i.rgb, image, jnp.clip(g * image.rgb, 0.0, 1.0))
