"""Render a laser scan of a planar map, and give its density: the emission of the plane (eq. M36).

    r_k = min {r: occupancy(p + r u_k) > 0},    log p(x | z, M) = share sum_k log Laplace(x_k; r_k, b)

The ray steps by the distance to the nearest surface that the mean states, and finds the crossing between two steps by
the line through both. Neighbouring beams err together, because the map does: they count as a share of independent ones.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner

RAY_STEPS = 400  # at most; half a cell each near surfaces, the band's width in free space
AT_LEAST = 0.5  # cells of a step


def render_scan(m: PlanarMap, scanner: Scanner, state: Float[Array, "3"]) -> Float[Array, "beams"]:
    """Return the ranges that the map's mean predicts; 0 where no surface is within the scanner's range.

    Args:
        m: the map.
        scanner: on the robot.
        state: of the robot: x, y (m), heading (rad).
    """
    at = scanner.pose(state)
    angle = at[2] + scanner.angles
    u = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    beams = len(scanner.angles)

    def advance(carry: tuple[Array, Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array, Array], None]:
        r, before, last, found = carry
        now = m.occupancy_at(at[:2] + r[:, None] * u)
        crossing = (now > 0.0) & (found == 0.0)
        between = last + (r - last) * before / jnp.minimum(before - now, -1e-12)
        found = jnp.where(crossing, jnp.where(r > 0.0, between, 1e-6), found)
        step = jnp.maximum(-now, AT_LEAST * m.cell_size)
        return (r + step, now, r, found), None

    zeros = jnp.zeros(beams)
    (_, _, _, found), _ = jax.lax.scan(advance, (zeros, zeros - 1.0, zeros, zeros), None, length=RAY_STEPS)
    return jnp.where(found <= scanner.max_range, found, 0.0)


class OccupancyScans(eqx.Module):
    """Predict scans by an occupancy map of the plane: a :class:`~vssm_gym.model.scan_model.ScanModel`.

    Attributes:
        m: the map.
        scanner: on the robot.
        scale: ``b`` of the Laplace distribution, m.
        share: of the beams that count as independent.
    """

    m: PlanarMap
    scanner: Scanner
    scale: float
    share: float = 1.0

    def ranges(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Return the ranges that the map's mean predicts, m; the scanner's range where it predicts no surface."""
        found = self._rendered(state)
        return jnp.where(found > 0.0, found, self.scanner.max_range)

    def log_prob(self, ranges: Float[Array, "beams"], state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of the beams that have measured and that meet a surface in the map, nats."""
        predicted = self._rendered(state)
        both = (ranges > 0.0) & (predicted > 0.0)
        nats = -jnp.abs(ranges - predicted) / self.scale - jnp.log(2.0 * self.scale)
        return self.share * jnp.sum(jnp.where(both, nats, 0.0), axis=-1)

    def sample(self, key: PRNGKeyArray, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Draw scans at the map's mean; 0 where it has no surface within the scanner's range."""
        found = self._rendered(state)
        drawn = found + self.scale * jax.random.laplace(key, found.shape)
        return jnp.where(found > 0.0, jnp.clip(drawn, 0.0, self.scanner.max_range), 0.0)

    def draw_map(self, key: PRNGKeyArray) -> "OccupancyScans":
        """Return this model with a map drawn from ``q(M)``, cell by cell."""
        away = jax.random.normal(key, self.m.occupancy.shape) / jnp.sqrt(self.m.precision)
        return eqx.tree_at(lambda model: model.m.occupancy, self, self.m.occupancy + away)

    def _rendered(self, state: Array) -> Array:
        found = jax.vmap(lambda one: render_scan(self.m, self.scanner, one))(state.reshape(-1, 3))
        return found.reshape(*state.shape[:-1], -1)


class ScanLikelihood(eqx.Module):
    """Describe ``p(x | z, M)`` of one scan as a function of the robot's pose.

    Attributes:
        ranges: measured, m; 0 where there is no reading.
        model: of the scans.
    """

    ranges: Float[Array, "beams"]
    model: ScanModel

    def log_prob(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of the scan at each pose, nats."""
        return self.model.log_prob(self.ranges, state)
