"""Relate strip images to charts of colours (eqs. I74, M38)."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from vssm_gym.errors import InputError
from vssm_gym.inference.latent.chart_update import add
from vssm_gym.inference.latent.decoder_fit import fit_decoder
from vssm_gym.maps.latent_grid import ChartDecoder, LatentGrid
from vssm_gym.model.latent_scans import FULL_TURN
from vssm_gym.model.latent_strips import COLOURS, LatentStrips, turned


@dataclass(frozen=True)
class StripConfig:
    """Configure inference from strips; the words are those of :class:`~.config.LatentConfig`.

    Args:
        latents: length of the vector of each colour in each cell.
        particles: of the pose.
        reading_std: of a pixel against a chart, brightness.
        counted: share of the pixels that count as independent in the pose.
        counted_map: share of a strip that counts as independent in a chart.
        huber: standard deviations from which a residual counts less.
        chunk: steps after which a strip is written.
    """

    latents: int = 24
    particles: int = 200
    reading_std: float = 0.02
    counted: float = 0.01
    counted_map: float = 1.0
    huber: float = 2.0
    chunk: int = 50

    def __post_init__(self) -> None:
        for name in ("latents", "particles", "reading_std", "counted", "counted_map", "huber", "chunk"):
            if not getattr(self, name) > 0:
                raise InputError("StripConfig", name, f"above 0, not {getattr(self, name)}")


class StripReading(eqx.Module):
    """Hold a strip.

    Attributes:
        pixels: brightness of red in every column, then green, then blue.
    """

    pixels: Float[Array, "*time pixels"]


class StripLikelihood(eqx.Module):
    """Describe ``p(x | z, M)`` of one strip as a function of the pose.

    Attributes:
        pixels: as of a :class:`StripReading`.
        model: of strips.
    """

    pixels: Float[Array, "pixels"]
    model: LatentStrips

    def log_prob(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of the strip at each pose, nats."""
        return self.model.log_prob(self.pixels, state)


class StripCharts(eqx.Module):
    """Write strips to charts, and weigh poses by them: a :class:`~.chart_update.ChartSensor`.

    Attributes:
        config: weights.
    """

    config: StripConfig = eqx.field(static=True)

    def model(self, m: LatentGrid) -> LatentStrips:
        """Return the model of strips under a map, as poses are weighed by it."""
        return LatentStrips(m, self.config.reading_std, self.config.counted, self.config.huber)

    def likelihood(self, m: LatentGrid, reading: StripReading) -> StripLikelihood:
        """Return ``p(x | z, M)`` of a strip as a function of the pose."""
        return StripLikelihood(reading.pixels, self.model(m))

    def write(
        self, m: LatentGrid, reading: StripReading, state: Float[Array, "3"], sign: float | Array = 1.0
    ) -> LatentGrid:
        """Return the map with one strip more, or one less."""
        i, j, share, _ = m.attention(state[:2])
        columns = m.chart.shape[-1] // COLOURS
        y = turned(reading.pixels, FULL_TURN * jnp.arange(columns) / columns - state[2])
        weight = sign * self.config.counted_map * share / self.config.reading_std**2
        return add(m, i, j, *(jnp.broadcast_to(a, (4, len(y))) for a in (y, weight[:, None])))


def brightness(images: UInt8[np.ndarray, "scans columns 3"]) -> Float[np.ndarray, "scans pixels"]:
    """Return the pixels of strips in (0, 1], one channel after the other."""
    return ((images.astype(np.float32) + 1.0) / 256.0).transpose(0, 2, 1).reshape(len(images), -1)


def fit_strip_decoder(pixels: Float[np.ndarray, "scans pixels"], latents: int) -> ChartDecoder:
    """Return the decoder of charts of colours: the same components for each channel."""
    columns = pixels.shape[1] // COLOURS
    angles = 2.0 * np.pi * np.arange(columns) / columns
    one = fit_decoder(pixels.reshape(-1, columns), angles, columns, min(latents, columns))
    return ChartDecoder(one.mean, jnp.kron(jnp.eye(COLOURS), one.basis))
