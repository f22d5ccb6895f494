"""Summarise the posterior predictive: envelopes of states, means and variances of images (VSSM-LM, PRISM).

From samples of :func:`vssm_gym.model.spatial_model.rollout`: at every step a mean state on the manifold, the covariance
of the errors ``xi`` with ``z = perturb(mean, xi)``, and the ellipsoid that holds a given share of the futures.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition.manifold import Manifold

MEAN_STEPS = 5  # iterations of the mean on the manifold; two or three suffice unless rotations spread by a radian
STD_FLOOR = 1e-6  # m, rad: the resolution of float32 poses; avoids division by zero for degenerate ellipsoids


class Envelope(eqx.Module):
    """Represent a region ``(xi^T covariance^-1 xi <= radius2)`` at every step."""

    mean: Any  # a state pytree with leading time axis
    covariance: Float[Array, "time n n"]  # of xi, in the order of the manifold's errors: (m, rad[, m/s, rad/s])
    radius2: Float[Array, "time"]  # a quantile of the samples, not of chi-square: futures need not be Gaussian


class ImageSummary(eqx.Module):
    """Hold mean and variance of each pixel over the futures that see a surface there."""

    depth_mean: Float[Array, "*batch height width"]  # m; 0 where no future sees one
    depth_variance: Float[Array, "*batch height width"]  # m^2; infinite there
    rgb_mean: Float[Array, "*batch height width 3"]
    rgb_variance: Float[Array, "*batch height width 3"]
    hit_share: Float[Array, "*batch height width"]  # futures that see a surface, [0, 1]
    known_share: Float[Array, "*batch height width"]  # futures that see an observed one, [0, 1]


@partial(jax.jit, static_argnames=("manifold", "level", "coordinates"))
def envelope(manifold: Manifold, states: Any, level: float = 0.95, coordinates: int | None = None) -> Envelope:
    """Compute the region that holds a share ``level`` of the futures at each step (eq. M28).

    Args:
        manifold: Of the states.
        states: Pytree of (samples, time, ...).
        level: Share of the futures inside.
        coordinates: How many of the first coordinates of ``xi`` to use: 6 for the pose of a rigid body; default all.
            There must be several times as many samples.

    Returns:
        Mean, covariance and squared radius a step.
    """
    mean = jax.tree.map(lambda a: a[0], states)
    for _ in range(MEAN_STEPS):
        mean = manifold.perturb(mean, manifold.error(mean, states).mean(axis=0))
    xi = manifold.error(mean, states)[..., :coordinates]
    n = xi.shape[0]
    covariance = jnp.einsum("kti,ktj->tij", xi, xi) / (n - 1)
    # Compare each sample with mean and covariance of the others: its own contribution would shrink the region.
    q = _distance2(xi, covariance) / (n - 1)
    left_out = (n / (n - 1)) ** 2 * (n - 2) * q / jnp.maximum(1.0 - n / (n - 1) * q, 1e-6)
    return Envelope(mean, covariance, jnp.quantile(left_out, level, axis=0))


@partial(jax.jit, static_argnames="manifold")
def distance2(manifold: Manifold, region: Envelope, states: Any) -> Float[Array, "*batch time"]:
    """``xi^T covariance^-1 xi``: the squared Mahalanobis distance of states (..., time) to the mean."""
    xi = manifold.error(region.mean, states)[..., : region.covariance.shape[-1]]
    return _distance2(xi, region.covariance)


@partial(jax.jit, static_argnames="manifold")
def inside(manifold: Manifold, region: Envelope, states: Any) -> Bool[Array, "*batch time"]:
    """Return which states (..., time) lie in the region of their step (eq. M28)."""
    return distance2(manifold, region, states) <= region.radius2


@jax.jit
def image_summary(images: RGBD, scales: EmissionScales) -> ImageSummary:
    """``E[x]`` and ``var[x] = var[mu] + 2 sigma^2`` of each pixel: spread between futures plus Laplace emission noise.

    Outliers are left out: a few per cent of them, at the depth of any surface, would decide every variance.

    Args:
        images: Arrays (samples, ..., height, width[, 3]) of :class:`~vssm_gym.model.spatial_model.Rollouts`.
        scales: ``sigma_E`` of the emission; depth's is taken at the mean depth.
    """
    hit = images.hit.astype(jnp.float32)
    count = hit.sum(axis=0)

    def moments(values, weight, n, variance_at):
        mean = jnp.sum(weight * values, axis=0) / jnp.maximum(n, 1.0)
        spread = jnp.sum(weight * (values - mean) ** 2, axis=0) / jnp.maximum(n - 1.0, 1.0)
        return mean, jnp.where(n > 0.0, spread + variance_at(mean), jnp.inf)

    depth_mean, depth_variance = moments(images.depth, hit, count, lambda depth: 2.0 * scales.depth_at(depth) ** 2)
    rgb_mean, rgb_variance = moments(images.rgb, hit[..., None], count[..., None], lambda _: scales.rgb_variance)
    known = images.known.astype(jnp.float32).mean(axis=0)
    return ImageSummary(depth_mean, depth_variance, rgb_mean, rgb_variance, hit.mean(axis=0), known)


def _distance2(xi: Array, covariance: Array) -> Array:
    variances, axes = jnp.linalg.eigh(covariance)
    floor = jnp.maximum(STD_FLOOR**2, 1e-6 * variances[..., -1:])  # eigenvalues below are rounding
    return jnp.sum(jnp.einsum("...ti,tij->...tj", xi, axes) ** 2 / jnp.maximum(variances, floor), axis=-1)
