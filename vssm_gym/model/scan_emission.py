"""Render a laser scan of a planar map, and give its density: the emission of the plane (eq. M36).

    r_k = min {r: occupancy(p + r u_k) > 0},    log p(x | z, M) = share sum_k log Laplace(x_k; r_k, b)

The ray steps by the distance to the nearest surface that the mean states, and finds the crossing between two steps by
the line through both. Neighbouring beams err together, because the map does: they count as a share of independent ones.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.transition.odometry import Odometry

RAY_STEPS = 400  # at most; half a cell each near surfaces, the band's width in free space
AT_LEAST = 0.5  # cells of a step


class Scanner(eqx.Module):
    """Hold a planar laser scanner on a robot.

    Attributes:
        angles: of the beams on the robot, counter-clockwise from ahead, rad; evenly spaced.
        mount: pose on the robot: forward, left (m), turn (rad).
        max_range: m.
    """

    angles: Float[Array, "beams"]
    mount: Float[Array, "3"]
    max_range: Float[Array, ""]

    def pose(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Return the scanner's pose of a robot's, x, y (m), heading (rad)."""
        return Odometry((0.0, 0.0, 0.0)).mean(state, self.mount, 0.0)

    def endpoints(self, state: Float[Array, "3"], ranges: Float[Array, "beams"]) -> Float[Array, "beams 2"]:
        """Return where the beams of a scan end, m."""
        at = self.pose(state)
        angle = at[2] + self.angles
        return at[:2] + ranges[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


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


class ScanLikelihood(eqx.Module):
    """Describe ``p(x | z, M)`` of one scan as a function of the robot's pose.

    Attributes:
        ranges: measured, m; 0 where there is no reading.
        m: the map.
        scanner: on the robot.
        scale: ``b`` of the Laplace distribution, m.
        share: of the beams that count as independent.
    """

    ranges: Float[Array, "beams"]
    m: PlanarMap
    scanner: Scanner
    scale: float
    share: float = 1.0

    def log_prob(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of the beams that have measured and that meet a surface in the map."""
        flat = state.reshape(-1, 3)
        predicted = jax.vmap(lambda one: render_scan(self.m, self.scanner, one))(flat)
        both = (self.ranges > 0.0) & (predicted > 0.0)
        nats = -jnp.abs(self.ranges - predicted) / self.scale - jnp.log(2.0 * self.scale)
        return self.share * jnp.sum(jnp.where(both, nats, 0.0), axis=-1).reshape(state.shape[:-1])
