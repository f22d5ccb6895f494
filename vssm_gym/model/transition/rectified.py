"""``g = max(0, a + e), e ~ N(0, sigma^2)``: moments of a motion that noise shortens or lengthens but never reverses."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float


class Rectified(NamedTuple):
    """Hold the moments of ``g``, in closed form."""

    mean: Float[Array, "*batch"]  # E[g]
    variance: Float[Array, "*batch"]  # Var[g]
    with_noise: Float[Array, "*batch"]  # Cov[g, e]


def rectified(size: Float[Array, "*batch"], std: Float[Array, "*#batch"] | float) -> Rectified:
    """``E[g] = a Phi(a / s) + s phi(a / s)``, ``E[g^2] = (a^2 + s^2) Phi + a s phi``, ``Cov[g, e] = s^2 Phi``.

    Args:
        size: a, of the commanded motion, with the mean of its noise; any unit.
        std: s >= 0, of the noise, in the same unit.
    """
    s = jnp.maximum(std, 1e-9)
    inside, density = norm.cdf(size / s), norm.pdf(size / s)
    mean = size * inside + s * density
    # E[g^2] - E[g]^2 without the difference of squares, which would lose float32's digits where a is far above s
    variance = s**2 * inside - size * s * density * (2.0 * inside - 1.0)
    variance += size**2 * inside * (1.0 - inside) - (s * density) ** 2
    return Rectified(mean, jnp.maximum(variance, 0.0), s**2 * inside)
