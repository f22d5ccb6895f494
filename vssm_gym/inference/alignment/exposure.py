"""Exposure: ``x_map = g x``, the gain by which an image is as bright as the map (ours, beyond PRISM).

A camera exposes for what it sees and changes its gain when it turns to a window. The gain is the ratio of the mean
luminances over the pixels that map and image both show: means do not care that rendered images are blurred, nor much
about a pose that is still a little off. With it images are compared and enter the map, which so keeps one exposure.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.model.emission import RGBD

LIMIT = 4.0  # gains lie within [1 / LIMIT, LIMIT]: what is darker or brighter has lost its detail
DARK = 0.01  # luminance added to both means, so that a black image has a gain too


def gain(
    reference: Float[Array, "*pixels"], observed: Float[Array, "*pixels"], both: Bool[Array, "*pixels"]
) -> Float[Array, ""]:
    """``mean(reference) / mean(observed)`` of luminances in [0, 1] over the pixels seen in ``both``; 1 without any."""
    count = jnp.maximum(jnp.sum(both), 1)
    bright, dark = jnp.sum(reference * both) / count, jnp.sum(observed * both) / count
    return jnp.clip((bright + DARK) / (dark + DARK), 1.0 / LIMIT, LIMIT)


def expose(image: RGBD, g: Float[Array, ""]) -> RGBD:
    """The image at another exposure; what is brighter than white stays white."""
    return eqx.tree_at(lambda i: i.rgb, image, jnp.clip(g * image.rgb, 0.0, 1.0))
