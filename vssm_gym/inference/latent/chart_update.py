"""Write a scan to the charts around it, or erase it: the posterior of the map given poses (eq. I74).

    natural parameters of chart ij += alpha_ij(z) (w, w (y - mean)),    y the scan seen from the cell's centre

The bilinear mean of four charts is at least as near to a scan as they are on average (Jensen). So the sum over the four
of ``alpha_ij log N(y; chart ij, 1 / w)`` bounds the log density from below, and is maximal in closed form, each chart
by itself. What a scan added can be taken away: a chunk of steps is inferred under the map of the others.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.latent_scans import FULL_TURN, at_bearing, seen_from
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


def write(
    m: LatentGrid,
    scan: Panorama,
    state: Float[Array, "3"],
    scanner: Scanner,
    config: LatentConfig,
    sign: float | Array = 1.0,
) -> LatentGrid:
    """Return the map with one scan more, or one less.

    Args:
        m: the map.
        scan: at the bearings of its charts.
        state: of the robot: x, y (m), heading (rad).
        scanner: on the robot.
        config: weights.
        sign: 1 writes, -1 erases what was written at this very state, 0 leaves the map as it is.
    """
    at = scanner.pose(state)
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
    total = jnp.maximum(m.weight[i, j] + weight, 0.0)
    moment = m.moment[i, j] + weight * (y - m.decoder.mean)
    moment = jnp.where(total > 0.0, moment, 0.0)
    mean, root = m.decoder.posterior(total, moment)
    through = jax.scipy.linalg.solve_triangular(
        root, jnp.broadcast_to(m.decoder.basis, (4, *m.decoder.basis.shape)), lower=True
    )
    found = total, moment, m.decoder(mean), jnp.sqrt(jnp.sum(through**2, axis=1))
    fields = lambda m: (m.weight, m.moment, m.chart, m.spread)
    return eqx.tree_at(fields, m, tuple(old.at[i, j].set(new) for old, new in zip(fields(m), found, strict=True)))
