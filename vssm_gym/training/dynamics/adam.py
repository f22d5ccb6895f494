"""Minimise by Adam with decoupled weight decay (Kingma and Ba, ICLR 2015; Loshchilov and Hutter, ICLR 2019)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.inference.alignment.adam import EPSILON

BETA1, BETA2 = 0.9, 0.999  # the published ones


class Moments(eqx.Module):
    """Hold what Adam remembers of past gradients."""

    mean: Any
    square: Any
    count: Float[Array, ""]


def no_moments(parameters: Any) -> Moments:
    """Return those before the first step."""
    zero = jax.tree.map(jnp.zeros_like, parameters)
    return Moments(zero, zero, jnp.zeros(()))


def adam(
    parameters: Any, gradient: Any, moments: Moments, rate: float | Array, decay: float = 0.0, largest: float = 1.0
) -> tuple[Any, Moments]:
    """Take one step.

    Args:
        parameters: a tree of arrays.
        gradient: of the same form; one that is not finite changes nothing.
        moments: of past gradients.
        rate: length of a step in each parameter.
        decay: share of the parameters that is subtracted, times the rate.
        largest: norm of the gradient; a longer one is shortened.

    Returns:
        Parameters and moments after the step.
    """
    norm = jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(gradient)))
    finite = jnp.isfinite(norm)
    shrink = jnp.minimum(1.0, largest / jnp.maximum(norm, 1e-12))
    gradient = jax.tree.map(lambda g: jnp.where(finite, g * shrink, 0.0), gradient)
    count = moments.count + 1.0
    mean = jax.tree.map(lambda m, g: BETA1 * m + (1.0 - BETA1) * g, moments.mean, gradient)
    square = jax.tree.map(lambda s, g: BETA2 * s + (1.0 - BETA2) * g**2, moments.square, gradient)

    def moved(p: Array, m: Array, s: Array) -> Array:
        step = (m / (1.0 - BETA1**count)) / (jnp.sqrt(s / (1.0 - BETA2**count)) + EPSILON)
        return p - jnp.where(finite, rate, 0.0) * (step + decay * p)

    return jax.tree.map(moved, parameters, mean, square), Moments(mean, square, count)
