"""Relate scans to charts of ranges: a scan seen from a cell's centre is what its chart should be (eqs. I74, M38)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.latent.chart_update import add
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.latent_scans import FULL_TURN, LatentScans, at_bearing, seen_from
from vssm_gym.model.scan_emission import ScanLikelihood
from vssm_gym.model.scanner import Scanner


class Panorama(NamedTuple):
    """Hold a scan at the bearings of a chart, in the scanner's frame."""

    ranges: Float[Array, "bearings"]  # m
    valid: Float[Array, "bearings"]  # 1 where there is a reading, else 0


def panorama(ranges: Float[Array, "beams"], scanner: Scanner, bearings: int) -> Panorama:
    """Return a scan between its beams, linearly; where one of the two has no reading there is none."""
    beams = len(scanner.angles)
    spacing = (scanner.angles[-1] - scanner.angles[0]) / (beams - 1)
    around = beams * spacing > FULL_TURN - 0.5 * spacing
    wanted = FULL_TURN * jnp.arange(bearings) / bearings
    after = jnp.mod(wanted - scanner.angles[0] + 1e-4 * spacing, FULL_TURN) / spacing - 1e-4
    low = jnp.floor(after + 1e-3)
    first = low.astype(int)
    i = jnp.clip(first, 0, beams - 1)
    j = jnp.where(around, (first + 1) % beams, jnp.minimum(first + 1, beams - 1))
    inside = around | (after <= beams - 1.0 + 1e-3)
    a, b = ranges[i], ranges[j]
    return Panorama(a + jnp.clip(after - low, 0.0, 1.0) * (b - a), (inside & (a > 0.0) & (b > 0.0)).astype(jnp.float32))


class ScanReading(NamedTuple):
    """Hold a scan twice."""

    beams: Float[Array, "beams"]  # m; 0 where there is no reading
    around: Panorama


class ScanCharts(eqx.Module):
    """Write scans to charts, and weigh poses by them: a :class:`~.chart_update.ChartSensor`.

    Attributes:
        scanner: on the robot.
        config: weights.
    """

    scanner: Scanner
    config: LatentConfig = eqx.field(static=True)

    def model(self, m: LatentGrid) -> LatentScans:
        """Return the model of scans under a map, as poses are weighed by it."""
        std = self.config.reading_std * m.cell_size
        return LatentScans(m, self.scanner, std, self.config.counted, self.config.huber)

    def likelihood(self, m: LatentGrid, reading: ScanReading) -> ScanLikelihood:
        """Return ``p(x | z, M)`` of a scan as a function of the pose."""
        return ScanLikelihood(reading.beams, self.model(m))

    def write(
        self, m: LatentGrid, reading: ScanReading, state: Float[Array, "3"], sign: float | Array = 1.0
    ) -> LatentGrid:
        """Return the map with one scan more, or one less."""
        scan, config = reading.around, self.config
        at = self.scanner.pose(state)
        i, j, share, away = m.attention(at[:2])
        c, s = jnp.cos(at[2]), jnp.sin(at[2])
        back = -jnp.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=-1)
        bearings = m.chart.shape[-1]
        bearing = wrap_angle(FULL_TURN * jnp.arange(bearings) / bearings - at[2])
        four = lambda a: jnp.broadcast_to(a, (4, bearings))
        half = 0.5 * FULL_TURN / bearings
        before, y, after = (seen_from(four(scan.ranges), back, four(bearing + turn)) for turn in (-half, 0.0, half))
        valid = at_bearing(four(scan.valid), four(bearing)) > 1.0 - 1e-3
        variance = (config.reading_std * m.cell_size) ** 2 + (config.slope * (after - before)) ** 2
        weight = sign * config.counted_map * share[:, None] * jnp.where(valid, 1.0, 0.0) / variance
        return add(m, i, j, y, weight)
