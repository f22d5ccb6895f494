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
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner

RAY_STEPS = 400  # at most; half a cell each near surfaces, the band's width in free space
AT_LEAST = 0.5  # cells of a step
DRAWN_BAND = 4.0  # cells, largest distance that a cell of a drawn map states, as the map update's band


def render_scan(m: PlanarMap, scanner: Scanner, state: Float[Array, "3"]) -> Float[Array, "beams"]:
    """Return the ranges that the map's mean predicts; 0 where no surface is within the scanner's range.

    The march ends when every beam has met a surface or passed the scanner's range. It only finds between which two
    points a beam crosses a surface; the crossing itself is differentiable in the state and in the map.

    Args:
        m: the map.
        scanner: on the robot.
        state: of the robot: x, y (m), heading (rad).
    """
    at = scanner.pose(state)
    angle = at[2] + scanner.angles
    u = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    near, far = _crossed(*jax.lax.stop_gradient((m, at[:2], u, scanner.max_range)))
    before, after = (m.occupancy_at(at[:2] + r[:, None] * u) for r in (near, far))
    between = near - (far - near) * before / jnp.maximum(after - before, 1e-12)
    found = jnp.where(far > 0.0, between, 1e-6)
    return jnp.where((far >= 0.0) & (found <= scanner.max_range), found, 0.0)


def _crossed(m: PlanarMap, xy: Array, u: Array, max_range: Array) -> tuple[Array, Array]:
    """Return the ends of the step in which each beam meets a surface; the far one is 0 inside a surface, -1: none."""
    beams = len(u)

    def going(carry: tuple[Array, ...]) -> Array:
        return ~jnp.all(carry[-2]) & (carry[-1] < RAY_STEPS)

    def advance(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        r, last, near, far, done, steps = carry
        now = m.occupancy_at(xy + r[:, None] * u)
        crossing = (now > 0.0) & ~done
        near, far = jnp.where(crossing, last, near), jnp.where(crossing, r, far)
        step = jnp.maximum(-now, AT_LEAST * m.cell_size)
        return r + step, r, near, far, done | crossing | (r > max_range), steps + 1

    zeros = jnp.zeros(beams)
    start = (zeros, zeros, zeros, zeros - 1.0, jnp.zeros(beams, bool), jnp.int32(0))
    ended = jax.lax.while_loop(going, advance, start)  # type: ignore[arg-type]  # a tuple of six
    return ended[2], ended[3]


class OccupancyScans(eqx.Module):
    """Predict scans by an occupancy map of the plane: a :class:`~vssm_gym.model.scan_model.ScanModel`.

    Attributes:
        m: the map.
        scanner: on the robot.
        scale: ``b`` of the Laplace distribution, m.
        share: of the beams that count as independent.
        free_path: cells that a beam passes in unknown space of a drawn map before it meets something, on average.
    """

    m: PlanarMap
    scanner: Scanner
    scale: float
    share: float = 1.0
    free_path: float = 20.0

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
        """Return this model with a map drawn from ``q(M)`` as its mean (eq. M37).

        A known cell is drawn from its Gaussian. The prior of an unknown one is 10 m wide, which is to say that nothing
        is known of it; drawn cell by cell, every second one would be solid, and a beam would end in the first two,
        wherever it looks. Unknown cells are therefore solid at random, so rarely that beams pass ``free_path`` of them.
        What is drawn free states no more free space than its neighbours leave, because a beam steps by what it states.
        """
        by_cell, by_chance = jax.random.split(key)
        m, band = self.m, DRAWN_BAND * self.m.cell_size
        away = jax.random.normal(by_cell, m.occupancy.shape) / jnp.sqrt(m.precision)
        solid = jax.random.uniform(by_chance, m.occupancy.shape) > jnp.exp(-1.0 / self.free_path)
        unknown = jnp.where(solid, m.cell_size, -band)
        drawn = jnp.where(m.precision > OBSERVED_PRECISION, jnp.clip(m.occupancy + away, -band, band), unknown)
        consistent = jnp.maximum(drawn, -m.cell_size * _cells_to_solid(drawn > 0.0))
        return eqx.tree_at(lambda model: model.m.occupancy, self, jnp.where(drawn > 0.0, drawn, consistent))

    def _rendered(self, state: Array) -> Array:
        found = jax.vmap(lambda one: render_scan(self.m, self.scanner, one))(state.reshape(-1, 3))
        return found.reshape(*state.shape[:-1], -1)


def _cells_to_solid(solid: Array) -> Array:
    """Return the distance of each cell to the nearest solid one, cells, up to :data:`DRAWN_BAND` (a chamfer)."""
    nx, ny = solid.shape
    away = jnp.where(solid, 0.0, DRAWN_BAND)
    for _ in range(int(DRAWN_BAND)):
        rim = jnp.pad(away, 1, constant_values=DRAWN_BAND)
        for i, j in ((0, 1), (1, 0), (1, 2), (2, 1), (0, 0), (0, 2), (2, 0), (2, 2)):
            away = jnp.minimum(away, rim[i : i + nx, j : j + ny] + (1.0 if 1 in (i, j) else 2.0**0.5))
    return away


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
