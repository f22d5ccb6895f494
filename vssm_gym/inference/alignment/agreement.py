"""``c(T) = mean min(|s_rgb|, 3)``, ``rho(T) = corr(I^[pi(T p)], I[pi(p)])``: does the colour confirm a pose? (ours)

Depth and colour are two witnesses of one pose. A false depth image, wrong in its scale or of another moment, moves the
pose by its geometry, and the colour then fits worse than where the camera was before. A false colour image does not
correlate with the reference at the pose that the geometry gives. A featureless image confirms nothing: what it shows
does not fix the pose.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_adjoint
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    ObservedPixels,
    ReferencePixels,
    Term,
    linearise,
    normal_equations,
    stride,
)


class Agreement(NamedTuple):
    """Measure how well the colours of an image and its reference agree at a pose (eq. I28)."""

    cost: Float[Array, ""]  # mean min(|s_rgb|, limit) against the sharpest colour of the reference, over common pixels
    correlation: Float[Array, ""]  # of the luminances of common pixels, with the best colour of the reference
    contrast: Float[Array, ""]  # standard deviation of the image's luminance over rgb_sigma, over common pixels
    share: Float[Array, ""]  # of the observed pixels that have a colour in the reference


def agreement(
    T: Float[Array, "4 4"], ref: ReferencePixels, obs: ObservedPixels, camera: Camera, factor: int, config: AlignConfig
) -> Agreement:
    """Compare the colours of an image and its reference at ``T`` = T_ref_cam.

    Args:
        T: the pose.
        ref: the reference, shrunk by ``factor``; the camera image seen there, where it has one, is its sharpest colour.
        obs: the image, likewise, at the reference's exposure.
        camera: of the images before shrinking.
        factor: they were shrunk by.
        config: scales.
    """
    _, *colours = linearise(T, ref, obs, camera, factor, config)
    sharpest = colours[-1]
    common = sharpest.usable / jnp.maximum(jnp.sum(sharpest.usable), 1)
    cost = jnp.sum(common * jnp.minimum(jnp.abs(sharpest.residual), config.cost_limit))
    correlation = jnp.max(jnp.stack([_correlation(term, obs.luminance, config) for term in colours]))
    mean = jnp.sum(common * obs.luminance)
    contrast = jnp.sqrt(jnp.sum(common * (obs.luminance - mean) ** 2)) / config.rgb_sigma
    share = jnp.sum(sharpest.usable) / jnp.maximum(jnp.sum(obs.valid), 1)
    return Agreement(cost, correlation, contrast, share)


def _correlation(term: Term, luminance: Float[Array, "pixels"], config: AlignConfig) -> Float[Array, ""]:
    """Return the correlation of an image with the reference, whose luminance is the image's plus the residual."""
    weight = term.usable / jnp.maximum(jnp.sum(term.usable), 1)
    reference = luminance + config.rgb_sigma * term.residual
    a, b = (x - jnp.sum(weight * x) for x in (luminance, reference))
    # Below a thousandth of the range there is nothing to correlate.
    return jnp.sum(weight * a * b) / jnp.maximum(jnp.sqrt(jnp.sum(weight * a * a) * jnp.sum(weight * b * b)), 1e-6)


def fixes_pose(
    T: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    ref: ReferencePixels,
    obs: ObservedPixels,
    camera: Camera,
    config: AlignConfig,
    std: float,
) -> Bool[Array, ""]:
    """``lambda_min(2 B^T J^T J B) >= std^-2``: the image alone, without a prior, fixes every coordinate (eq. I30).

    Colour counts at edges only, where the reference changes by a standard deviation between the two neighbours of a
    pixel: on a bare wall, weak gradients of thousands of pixels would add up to a certainty that they do not have.

    Args:
        T: T_ref_cam.
        basis: B, the twists along which the camera may move.
        ref: the reference at full size.
        obs: the image, likewise.
        camera: of both.
        config: scales.
        std: largest standard deviation of a coordinate, m or rad.
    """
    edge = jnp.hypot(ref.image[1], ref.image[2]) > 0.5 * config.rgb_sigma
    edges = eqx.tree_at(lambda r: (r.textured, r.seen), ref, (ref.textured & edge, None), is_leaf=lambda x: x is None)
    geo, rgb = linearise(T, edges, obs, camera, 1, config)
    share = stride(camera, 1, config) ** 2 / config.pixels_per_datum
    weights = (share, share * config.rgb_weight)
    close = [
        term._replace(weight=weight * (term.usable & (jnp.abs(term.residual) < config.inlier)))
        for term, weight in zip((geo, rgb), weights, strict=True)
    ]
    H, _ = normal_equations(*close)
    twists = se3_adjoint(T) @ basis
    return jnp.linalg.eigvalsh(2.0 * twists.T @ H @ twists)[0] >= std**-2
