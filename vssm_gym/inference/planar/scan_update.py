"""``q_t(M) ∝ q_t-1(M) q(M | x_t, z_t)``: the closed-form map update by a scan (eq. I71).

    o = clip(|c - p| - r(bearing of c), -band, band),    mean and precision as of a Gaussian observation

A cell is compared with the beam that passes nearest: behind the surface by less than the band, or before it. It is the
update of a posed depth image (:mod:`vssm_gym.inference.mapping.map_update`) with a range for each bearing.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.mapping.map_update import fuse
from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scanner import Scanner

FULL_CIRCLE = 2.0 * np.pi  # rad


def update(
    m: PlanarMap, ranges: Float[Array, "beams"], state: Float[Array, "3"], scanner: Scanner, config: PlanarConfig
) -> PlanarMap:
    """Return the map after one scan.

    Args:
        m: the map.
        ranges: of the scan, m; 0 where there is no reading.
        state: of the robot: x, y (m), heading (rad).
        scanner: on the robot.
        config: width of the band and weights.
    """
    at = scanner.pose(state)
    away = m.centres() - at[:2]
    distance = jnp.linalg.norm(away, axis=-1)
    beam, covered = _nearest_beam(jnp.arctan2(away[..., 1], away[..., 0]) - at[2], scanner)
    r, band = ranges[beam], config.band * m.cell_size
    behind = distance - r
    seen = covered & (r > 0.0) & (behind < band) & (distance < scanner.max_range)
    one = 1.0 / (config.reading_std * m.cell_size) ** 2
    weight = jnp.where(seen, jnp.where(behind < -band, config.free_weight, 1.0) * one, 0.0)
    observed = jnp.where(seen, jnp.clip(behind, -band, band), 0.0)
    mean, precision = fuse(m.occupancy, m.precision, observed, weight)
    return PlanarMap(mean, jnp.minimum(precision, config.most_scans * one), m.origin, m.cell_size)


def _nearest_beam(bearing: Array, scanner: Scanner) -> tuple[Array, Array]:
    """Return the number of the beam nearest to a bearing on the scanner, and whether one is within half its spacing."""
    beams = len(scanner.angles)
    spacing = (scanner.angles[-1] - scanner.angles[0]) / (beams - 1)
    after = jnp.mod(bearing - scanner.angles[0] + 0.5 * spacing, FULL_CIRCLE) / spacing
    beam = jnp.minimum(jnp.floor(after).astype(int), beams - 1)
    off = jnp.abs(wrap_angle(bearing - scanner.angles[beam]))
    return beam, off <= 0.5 * spacing * (1.0 + 1e-3)
