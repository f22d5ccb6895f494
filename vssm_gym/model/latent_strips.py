"""Predict strip images by the charts of a latent grid: DVBF-LM's second modality (eq. M38, no parallax).

    mu_ck(z) = sum_ij alpha_ij(z) colour of chart ij at the bearing of column k
    s_ck^2   = std^2 + var_ij(colours) + spread_ck^2

An image says nothing about the distance of what it shows, so a chart is seen from beside as from its centre; what that
is wrong by is in the variance, since the four charts around the robot then disagree.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.huber import huber_log_prob
from vssm_gym.model.latent_scans import FULL_TURN, at_bearing

COLOURS = 3  # channels of an image; a chart holds one after the other


class LatentStrips(eqx.Module):
    """Predict strips by a latent grid.

    Attributes:
        m: the map; a chart is brightness (0 to 1) of red at every bearing, then green, then blue.
        std: of a pixel against a chart that is known.
        counted: share of the pixels that count as independent.
        huber: standard deviations from which a residual counts less.
    """

    m: LatentGrid
    std: float
    counted: float = 1.0
    huber: float = 2.0

    def predict(
        self, state: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch pixels"], Float[Array, "*batch pixels"]]:
        """Return mean and variance of the pixels under ``q(M)``, without the sensor's noise."""
        i, j, share, _ = self.m.attention(state[..., :2])
        columns = self.m.chart.shape[-1] // COLOURS
        bearing = state[..., 2:] + FULL_TURN * jnp.arange(columns) / columns
        colour, spread = (turned(charts[i, j], bearing[..., None, :]) for charts in (self.m.chart, self.m.spread))
        mean = jnp.sum(share[..., None] * colour, axis=-2)
        apart = (colour - mean[..., None, :]) ** 2 + spread**2
        return mean, jnp.sum(share[..., None] * apart, axis=-2)

    def log_prob(self, strip: Float[Array, "pixels"], state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of a strip, up to the constant of the Huber density, nats."""
        mean, variance = self.predict(state)
        nats = huber_log_prob(strip - mean, variance + self.std**2, self.huber)
        return self.counted * jnp.sum(nats, axis=-1)


def turned(chart: Float[Array, "*batch pixels"], bearing: Float[Array, "*wider columns"]) -> Array:
    """Return the colours of a chart at other bearings, one channel after the other."""
    channels = chart.reshape(*chart.shape[:-1], COLOURS, -1)
    wanted = jnp.broadcast_to(bearing[..., None, :], (*channels.shape[:-1], bearing.shape[-1]))
    return at_bearing(channels, wanted).reshape(*chart.shape[:-1], -1)
