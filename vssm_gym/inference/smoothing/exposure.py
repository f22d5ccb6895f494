"""Estimate the exposure of each image from what all images see of the same elements, by robust least squares.

    min_l,a  sum_v sum_t w_tv (log c_tv + l_t - a_v)^2,    w_tv = min(c_tv^2, ...) by Huber

with ``l_t`` the logarithm of the gain that makes image t as bright as the others, and ``a_v`` that of the element's
luminance, which is integrated out as in :mod:`~vssm_gym.inference.smoothing.agreement`. The mean of ``l`` is held at 0.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

DARKEST = 0.02  # luminance below which its logarithm says nothing
ELBOW = 0.1  # of the logarithm: larger differences are other surfaces or edges
GAIN_ROUNDS = 3  # times that the weights follow from the residuals
HELD = 1e-3  # of the mean weight of an image: precision of a gain about 1, which images without overlap need


def gains(luminance: Float[Array, "time elements"], seen: Float[Array, "time elements"]) -> Float[Array, "time"]:
    """Return the gain of each image.

    Args:
        luminance: of elements, as the images show them.
        seen: 1 where an image shows an element, or 0.
    """
    c = jnp.maximum(luminance, DARKEST)
    base, value = seen * c**2, jnp.log(c)
    log_gain, weight = jnp.zeros(len(c)), base
    for _ in range(GAIN_ROUNDS):
        total = jnp.maximum(jnp.sum(weight, axis=0), 1e-9)
        off = value - jnp.sum(weight * value, axis=0) / total
        held = HELD * jnp.mean(jnp.sum(weight, axis=1))
        H = jnp.diag(jnp.sum(weight, axis=1) + held) - (weight / total) @ weight.T
        log_gain = jnp.linalg.solve(H, -jnp.sum(weight * off, axis=1))
        log_gain = log_gain - jnp.mean(log_gain)
        left = value + log_gain[:, None]
        left = left - jnp.sum(weight * left, axis=0) / total
        weight = base * jnp.minimum(1.0, ELBOW / jnp.maximum(jnp.abs(left), 1e-6))
    return jnp.exp(log_gain)
