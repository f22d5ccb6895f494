"""Add what a reading says to the charts around it: the posterior of the map given poses (eq. I74).

    natural parameters of chart ij += alpha_ij(z) (w, w (y - mean)),    y the reading as the cell's chart would have it

The bilinear mean of four charts is at least as near to a reading as they are on average (Jensen). So the sum over the
four of ``alpha_ij log N(y; chart ij, 1 / w)`` bounds the log density from below, and is maximal in closed form, each
chart by itself. What a reading added can be taken away: a chunk of steps is inferred under the map of the others.
"""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vssm_gym.inference.particles.bootstrap import StateLikelihood
from vssm_gym.maps.latent_grid import LatentGrid


@runtime_checkable
class ChartSensor(Protocol):
    """Relate the readings of a sensor to charts; an implementation is a pytree."""

    def likelihood(self, m: LatentGrid, reading: Any) -> StateLikelihood:
        """Return ``p(x | z, M)`` of a reading as a function of the pose."""

    def write(self, m: LatentGrid, reading: Any, state: Float[Array, "3"], sign: float | Array) -> LatentGrid:
        """Return the map with one reading more (sign 1), or one less that was written at this very state (-1)."""


def add(
    m: LatentGrid,
    i: Int[Array, "4"],
    j: Int[Array, "4"],
    y: Float[Array, "4 bearings"],
    weight: Float[Array, "4 bearings"],
) -> LatentGrid:
    """Return the map with more in its four charts.

    Args:
        m: the map.
        i: of the cells.
        j: of the cells.
        y: the reading in each chart.
        weight: precision of each entry, the attention's share included; below 0 takes it away.
    """
    total = jnp.maximum(m.weight[i, j] + weight, 0.0)
    moment = jnp.where(total > 0.0, m.moment[i, j] + weight * (y - m.decoder.mean), 0.0)
    mean, root = m.decoder.posterior(total, moment)
    found = total, moment, m.decoder(mean), m.decoder.spread(root)
    fields = lambda m: (m.weight, m.moment, m.chart, m.spread)
    return eqx.tree_at(fields, m, tuple(old.at[i, j].set(new) for old, new in zip(fields(m), found, strict=True)))
