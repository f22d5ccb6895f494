"""Weigh particles and draw from them: importance weights, how many count, systematic resampling (eq. I69)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


def normalised(log_weight: Float[Array, "n"]) -> Float[Array, "n"]:
    """``log w_i - log sum_j w_j``; equal weights where all are zero, since then nothing is known of them."""
    total = jax.scipy.special.logsumexp(log_weight)
    equal = jnp.full_like(log_weight, -jnp.log(len(log_weight)))
    return jnp.where(jnp.isfinite(total), log_weight - total, equal)


def effective_number(log_weight: Float[Array, "n"]) -> Float[Array, ""]:
    """``(sum w)^2 / sum w^2``: the number of equally weighted particles with the same variance of a mean, in [1, n]."""
    return 1.0 / jnp.sum(jnp.exp(2.0 * normalised(log_weight)))


def systematic(key: PRNGKeyArray, log_weight: Float[Array, "n"], draws: int) -> Int[Array, "draws"]:
    """Draw particles so that each appears ``floor(draws w_i)`` or one time more, ``draws w_i`` on average.

    Args:
        key: random key.
        log_weight: of the particles, up to a constant.
        draws: number of draws.

    Returns:
        Their numbers, ascending.
    """
    levels = (jax.random.uniform(key) + jnp.arange(draws)) / draws
    reached = jnp.cumsum(jnp.exp(normalised(log_weight)))
    return jnp.clip(jnp.searchsorted(reached / reached[-1], levels), 0, len(log_weight) - 1)
