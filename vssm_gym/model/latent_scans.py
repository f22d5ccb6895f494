"""Predict scans by the charts of a latent grid: the emission of DVBF-LM, with the parallax of a chart (eq. M38).

    mu_k(z) = sum_ij alpha_ij(z) range of chart ij along beam k, seen from z
    log p(x | z, M) = counted sum_k log Huber((x_k - mu_k) / s_k),    s_k^2 = std^2 + var_ij(ranges) + spread^2

A chart is the ranges around its cell's centre. From a place beside it the same surfaces have other ranges: the surface
point on a ray is found by two fixed-point iterations. Where the four charts disagree, and where they know little, a
beam counts less.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.huber import huber_log_prob
from vssm_gym.model.scanner import Scanner

FULL_TURN = 2.0 * jnp.pi  # rad
PARALLAX_STEPS = 2  # fixed-point iterations: within a cell of the centre a third changes nothing
SHORTEST_RANGE = 1e-3  # m, of a prediction


def at_bearing(chart: Float[Array, "*batch bearings"], bearing: Float[Array, "*batch k"]) -> Float[Array, "*batch k"]:
    """Return a chart between its bearings, linearly."""
    n = chart.shape[-1]
    at = bearing * (n / FULL_TURN)
    low = jnp.floor(at)
    first = low.astype(int) % n
    a, b = (jnp.take_along_axis(chart, i, axis=-1) for i in (first, (first + 1) % n))
    return a + (at - low) * (b - a)


def seen_from(
    chart: Float[Array, "*batch bearings"], away: Float[Array, "*batch 2"], bearing: Float[Array, "*batch k"]
) -> Float[Array, "*batch k"]:
    """Return the ranges to a chart's surfaces from a place ``away`` from its centre, m.

    Args:
        chart: ranges from the centre, m.
        away: of the place, m.
        bearing: of the rays, rad, in the frame of the chart.
    """
    c, s = jnp.cos(bearing), jnp.sin(bearing)
    along = c * away[..., None, 0] + s * away[..., None, 1]
    across = c * away[..., None, 1] - s * away[..., None, 0]
    r = at_bearing(chart, bearing) - along
    for _ in range(PARALLAX_STEPS):
        ahead = along + r
        seen_at = bearing + jnp.arctan2(across, jnp.maximum(ahead, SHORTEST_RANGE))
        r = r + at_bearing(chart, seen_at) - jnp.hypot(ahead, across)
    return jnp.maximum(r, SHORTEST_RANGE)


class LatentScans(eqx.Module):
    """Predict scans by a latent grid: a :class:`~vssm_gym.model.scan_model.ScanModel`.

    Attributes:
        m: the map.
        scanner: on the robot.
        std: of a reading against a chart that is known, m.
        counted: share of the beams that count as independent.
        huber: standard deviations from which a residual counts less.
    """

    m: LatentGrid
    scanner: Scanner
    std: float | Float[Array, ""]
    counted: float = 1.0
    huber: float = 2.0

    def predict(
        self, state: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch beams"], Float[Array, "*batch beams"]]:
        """Return mean and variance of the ranges under ``q(M)``, without the sensor's noise, m and m^2."""
        at = self.scanner.pose(state)
        i, j, share, away = self.m.attention(at[..., :2])
        bearing = (at[..., 2:] + self.scanner.angles)[..., None, :]
        ranges = seen_from(self.m.chart[i, j], away, jnp.broadcast_to(bearing, (*i.shape, bearing.shape[-1])))
        spread = at_bearing(self.m.spread[i, j], jnp.broadcast_to(bearing, ranges.shape))
        mean = jnp.sum(share[..., None] * ranges, axis=-2)
        apart = (ranges - mean[..., None, :]) ** 2 + spread**2
        return mean, jnp.sum(share[..., None] * apart, axis=-2)

    def ranges(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Return the ranges that the charts' means predict, m; at most the scanner's range."""
        return jnp.minimum(self.predict(state)[0], self.scanner.max_range)

    def log_prob(self, ranges: Float[Array, "beams"], state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of the beams that have measured, up to the constant of the Huber density, nats."""
        mean, variance = self.predict(state)
        nats = huber_log_prob(ranges - mean, variance + self.std**2, self.huber)
        return self.counted * jnp.sum(jnp.where(ranges > 0.0, nats, 0.0), axis=-1)

    def sample(self, key: PRNGKeyArray, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Draw scans at the charts' means."""
        mean = self.ranges(state)
        drawn = mean + self.std * jax.random.normal(key, mean.shape)
        return jnp.clip(drawn, SHORTEST_RANGE, self.scanner.max_range)

    def draw_map(self, key: PRNGKeyArray) -> "LatentScans":
        """Return this model with charts drawn from ``q(M)``."""
        return eqx.tree_at(lambda model: model.m, self, self.m.draw(key))
