"""Estimate the evidence lower bound of poses and map, on a minibatch of steps (DVBF-LM; eq. I76).

    ELBO = T/|B| sum_t in B { E log p(x_t | z_t, M) + E log p(z_t | z_t-1, u_t-1) + H[q(z_t)] } - KL(q(M) | p(M))

Expectations are means over draws of the map and of neighbouring poses, which ``q`` holds independent.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.model.latent_scans import LatentScans
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR


class LatentElbo(NamedTuple):
    """Hold the terms, nats; their sum is the bound."""

    scans: Float[Array, ""]
    motions: Float[Array, ""]
    entropy: Float[Array, ""]
    divergence: Float[Array, ""]  # -KL of the map

    @property
    def total(self) -> Float[Array, ""]:
        """Return the bound, nats."""
        return self.scans + self.motions + self.entropy + self.divergence


def elbo(
    key: PRNGKeyArray,
    transition: Transition,
    model: LatentScans,
    mean: Float[Array, "time 3"],
    covariance: Float[Array, "time 3 3"],
    controls: Float[Array, "time m"],
    ranges: Float[Array, "time beams"],
    steps: Int[Array, "batch"],
    draws: int = 4,
) -> LatentElbo:
    """Return an estimate of the bound without bias.

    Args:
        key: random key.
        transition: between the poses.
        model: of scans, with ``q(M)``.
        mean: of ``q(z_t)``: x, y (m), heading (rad); the first pose is known.
        covariance: of each one's error.
        controls: from the step before; the first means nothing.
        ranges: of the scans, m.
        steps: numbers of the steps in the minibatch, at least 1 each.
        draws: of map and poses.
    """
    scale = (len(mean) - 1) / len(steps)

    def one(key: PRNGKeyArray) -> tuple[Array, Array]:
        of_map, before, now = jax.random.split(key, 3)
        drawn = model.draw_map(of_map)
        white = lambda key: jax.random.normal(key, (len(steps), 3))
        start = _draw(mean[steps - 1], covariance[steps - 1], white(before))
        start = jnp.where((steps == 1)[:, None], mean[0], start)
        after = _draw(mean[steps], covariance[steps], white(now))
        scans = jax.vmap(drawn.log_prob)(ranges[steps], after)
        return scale * jnp.sum(scans), scale * jnp.sum(transition.log_prob(after, start, controls[steps], 0.0))

    scans, motions = jax.lax.map(one, jax.random.split(key, draws))
    entropy = jax.vmap(lambda z, P: GaussianBelief(z, P, PLANAR).entropy())(mean[steps], covariance[steps])
    return LatentElbo(jnp.mean(scans), jnp.mean(motions), scale * jnp.sum(entropy), -model.m.divergence())


def _draw(mean: Array, covariance: Array, white: Array) -> Array:
    root = jnp.linalg.cholesky(covariance)
    return PLANAR.perturb(mean, jnp.einsum("...ij,...j->...i", root, white))
