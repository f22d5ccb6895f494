"""Weigh residuals by a density with tails that fall as an exponential's (Huber, 1964)."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def huber_log_prob(
    residual: Float[Array, "*batch"], variance: Float[Array, "*batch"], elbow: float | Array
) -> Float[Array, "*batch"]:
    """Return the log density ``-rho(e) - log std`` with ``e = residual / std``, up to a constant, nats.

    ``rho`` is ``e^2 / 2`` up to the elbow and linear beyond.

    Args:
        residual: of a measurement against its prediction.
        variance: of the two together.
        elbow: standard deviations from which a residual counts less.
    """
    e = jnp.abs(residual) / jnp.sqrt(variance)
    return -jnp.where(e < elbow, 0.5 * e**2, elbow * (e - 0.5 * elbow)) - 0.5 * jnp.log(variance)
