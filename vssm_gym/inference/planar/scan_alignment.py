"""``argmax_z p(x | z, M) q(z)`` of a scan, and its Laplace approximation (eq. I72).

    residual of beam k = occupancy(end of the beam at z) / std,    Gauss-Newton with the prior, Huber weights

Where a beam ends there is a surface: the mean occupancy is zero there, and its slope says how a pose is to move.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR

IN_BAND = 0.98  # of the band: beyond it the occupancy is cut off and has no slope


class Aligned(NamedTuple):
    """Hold the outcome of an alignment."""

    belief: GaussianBelief
    used: Float[Array, ""]  # share of the readings that end in the band of a known surface


def align(
    m: PlanarMap, ranges: Float[Array, "beams"], prior: GaussianBelief, scanner: Scanner, config: PlanarConfig
) -> Aligned:
    """Return the posterior of the robot's pose after a scan.

    Args:
        m: the map.
        ranges: of the scan, m; 0 where there is no reading.
        prior: predicted belief.
        scanner: on the robot.
        config: weights and iterations.
    """
    information = jnp.linalg.inv(prior.covariance)
    std, band = config.reading_std * m.cell_size, config.band * m.cell_size

    def residuals(xi: Float[Array, "3"], state: Float[Array, "3"]) -> Float[Array, "beams"]:
        return m.occupancy_at(scanner.endpoints(PLANAR.perturb(state, xi), ranges)) / std

    def iterate(state: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        ends = scanner.endpoints(state, ranges)
        off, J = residuals(jnp.zeros(3), state), jax.jacfwd(residuals)(jnp.zeros(3), state)
        good = (ranges > 0.0) & m.known_at(ends) & (jnp.abs(off) * std < IN_BAND * band)
        weight = config.share * jnp.where(good, jnp.minimum(1.0, config.huber / jnp.maximum(jnp.abs(off), 1e-6)), 0.0)
        H = (weight[:, None] * J).T @ J + information
        away = PLANAR.error(state, prior.mean)
        step = jnp.linalg.solve(H, information @ away - J.T @ (weight * off))
        used = jnp.sum(good) / jnp.maximum(jnp.sum(ranges > 0.0), 1)
        return PLANAR.perturb(state, step), (H, used)

    state, (H, used) = jax.lax.scan(iterate, prior.mean, None, length=config.iterations)
    covariance = jnp.linalg.inv(H[-1])
    return Aligned(GaussianBelief(state, 0.5 * (covariance + covariance.T), PLANAR), used[-1])
