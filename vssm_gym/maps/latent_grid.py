"""Hold a latent map of the plane: independent Gaussians over a vector in each cell of a grid (DVBF-LM).

    M_ij ~ N(0, I),    chart of cell ij = mean + W^T M_ij

A chart is what a scanner at the cell's centre would see: a range for each bearing of the map's frame. The decoder
``W`` is linear, so that ``q(M_ij)`` is a Gaussian whose natural parameters are sums over scans: a scan is written by
adding to them and erased by subtracting (:mod:`vssm_gym.inference.latent.chart_update`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.errors import InputError

MOST_LATENT_CELLS = 250_000  # 1 GB with 360 bearings


class ChartDecoder(eqx.Module):
    """Decode a latent vector to the ranges around a place.

    Attributes:
        mean: range at every bearing of the latent vector 0, m.
        basis: ``W``, m: what each latent adds at each bearing; bearings are evenly spaced from 0 on.
    """

    mean: Float[Array, ""]
    basis: Float[Array, "latents bearings"]

    def __call__(self, latent: Float[Array, "*batch latents"]) -> Float[Array, "*batch bearings"]:
        """Return the chart of a latent vector, m."""
        return self.mean + latent @ self.basis

    @property
    def prior_std(self) -> Float[Array, "bearings"]:
        """Return the standard deviation of a chart of which nothing is known, m."""
        return jnp.sqrt(jnp.sum(self.basis**2, axis=0))

    def posterior(
        self, weight: Float[Array, "*batch bearings"], moment: Float[Array, "*batch bearings"]
    ) -> tuple[Float[Array, "*batch latents"], Float[Array, "*batch latents latents"]]:
        """Return mean and lower Cholesky factor of the precision of ``q(M_ij)``: ``I + W diag(weight) W^T``.

        Args:
            weight: sums of the precisions of what was observed at each bearing, m^-2.
            moment: sums of precision times (range - mean), m^-1.
        """
        W = self.basis
        precision = jnp.eye(len(W)) + jnp.einsum("db,...b,eb->...de", W, weight, W)
        root = jnp.linalg.cholesky(precision)
        mean = jax.scipy.linalg.cho_solve((root, True), (moment @ W.T)[..., None])[..., 0]
        return mean, root

    def spread(self, root: Float[Array, "*batch latents latents"]) -> Float[Array, "*batch bearings"]:
        """Return the standard deviation of a chart, m, from the Cholesky factor of its latents' precision."""
        basis = jnp.broadcast_to(self.basis, (*root.shape[:-2], *self.basis.shape))
        through = jax.scipy.linalg.solve_triangular(root, basis, lower=True)
        return jnp.sqrt(jnp.sum(through**2, axis=-2))


class LatentGrid(eqx.Module):
    """Represent ``q(M)`` of a plane as charts.

    Attributes:
        weight: natural parameters of each chart, see :meth:`ChartDecoder.posterior`.
        moment: the same.
        chart: mean of each, m.
        spread: standard deviation of each, m.
        origin: x, y of the first cell's centre, m.
        cell_size: m.
        decoder: of the latent vectors.
    """

    weight: Float[Array, "nx ny bearings"]
    moment: Float[Array, "nx ny bearings"]
    chart: Float[Array, "nx ny bearings"]
    spread: Float[Array, "nx ny bearings"]
    origin: Float[Array, "2"]
    cell_size: Float[Array, ""]
    decoder: ChartDecoder

    @classmethod
    def prior(
        cls, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], cell_size: float, decoder: ChartDecoder
    ) -> "LatentGrid":
        """Return a map of which nothing is known.

        Args:
            low: x, y of its first cell, m.
            high: beyond which it ends.
            cell_size: m.
            decoder: of its latent vectors.

        Raises:
            InputError: no cells, or too many.
        """
        nx, ny = (np.ceil((np.asarray(high) - low) / cell_size).astype(int) + 1) if cell_size > 0.0 else (0, 0)
        if min(nx, ny) < 2 or nx * ny > MOST_LATENT_CELLS:
            raise InputError("latent grid", "cell_size", f"2 x 2 to {MOST_LATENT_CELLS:,} cells; found {nx} x {ny}")
        shape = int(nx), int(ny), decoder.basis.shape[1]
        none = jnp.zeros(shape)
        chart, spread = none + decoder.mean, jnp.broadcast_to(decoder.prior_std, shape)
        return cls(none, none, chart, spread, jnp.asarray(low, jnp.float32), jnp.float32(cell_size), decoder)

    @classmethod
    def of(
        cls,
        weight: Float[Array, "nx ny bearings"],
        moment: Float[Array, "nx ny bearings"],
        origin: Float[Array, "2"],
        cell_size: Float[Array, ""],
        decoder: ChartDecoder,
    ) -> "LatentGrid":
        """Return the map of natural parameters, see the attributes."""
        mean, root = decoder.posterior(weight, moment)
        return cls(weight, moment, decoder(mean), decoder.spread(root), origin, cell_size, decoder)

    def attention(
        self, xy: Float[Array, "*batch 2"]
    ) -> tuple[Int[Array, "*batch 4"], Int[Array, "*batch 4"], Float[Array, "*batch 4"], Float[Array, "*batch 4 2"]]:
        """Return the four cells around a point, their bilinear weights, and the point as seen from their centres, m."""
        last = jnp.asarray(self.chart.shape[:2], jnp.float32) - 1.0
        at = jnp.clip((xy - self.origin) / self.cell_size, 0.0, last)
        low = jnp.minimum(jnp.floor(at), last - 1.0)
        u, v = jnp.moveaxis(at - low, -1, 0)
        i, j = (low[..., axis].astype(int)[..., None] + jnp.array(offset) for axis, offset in enumerate(_CORNERS))
        share = jnp.stack([(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v], axis=-1)
        away = xy[..., None, :] - self.origin - self.cell_size * jnp.stack([i, j], axis=-1)
        return i, j, share, away

    @property
    def observed(self) -> np.ndarray:
        """Return which charts know more than the prior, ``(nx, ny)`` bool."""
        return np.asarray(jnp.mean(self.spread, axis=-1) < 0.5 * jnp.mean(self.decoder.prior_std))

    def centres(self) -> Float[Array, "nx ny 2"]:
        """Return x, y of every cell's centre, m."""
        nx, ny = self.chart.shape[:2]
        grid = jnp.stack(jnp.meshgrid(jnp.arange(nx), jnp.arange(ny), indexing="ij"), axis=-1)
        return self.origin + self.cell_size * grid

    def draw(self, key: PRNGKeyArray) -> "LatentGrid":
        """Return the map with charts drawn from ``q(M)``, without a spread."""
        mean, root = self.decoder.posterior(self.weight, self.moment)
        white = jax.random.normal(key, mean.shape)[..., None]
        away = jax.scipy.linalg.solve_triangular(root, white, trans="T", lower=True)[..., 0]
        fields = lambda m: (m.chart, m.spread)
        return eqx.tree_at(fields, self, (self.decoder(mean + away), jnp.zeros_like(self.spread)))

    def divergence(self) -> Float[Array, ""]:
        """Return ``KL(q(M) | p(M))``, nats."""
        mean, root = self.decoder.posterior(self.weight, self.moment)
        latents = mean.shape[-1]
        inverse = jax.scipy.linalg.solve_triangular(root, jnp.broadcast_to(jnp.eye(latents), root.shape), lower=True)
        trace = jnp.sum(inverse**2, axis=(-2, -1))
        log_det = 2.0 * jnp.sum(jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
        return 0.5 * jnp.sum(trace + jnp.sum(mean**2, axis=-1) - latents + log_det)


_CORNERS = ([0, 1, 0, 1], [0, 0, 1, 1])  # of a cell, in x and in y
