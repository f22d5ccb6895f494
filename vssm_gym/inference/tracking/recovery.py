"""Recover a lost pose: align the image to the map from several starts and keep the best accepted one (ours).

Recovery is needed where images can be rejected: after a loss of track, a filter without it would reject all images.
"""

from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.agreement import Agreement, agreement, fixes_pose
from vssm_gym.inference.alignment.aliasing import APART, COLOUR_MARGIN, is_unique
from vssm_gym.inference.alignment.depth_scale import fits_unscaled
from vssm_gym.inference.alignment.exposure import expose, gain
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    AlignInfo,
    luminance,
    make_observed,
    make_reference,
    score,
    stride,
)
from vssm_gym.inference.alignment.rotation import RotationConfig
from vssm_gym.inference.tracking.keyframes import KeyframeConfig
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD


@dataclass(frozen=True)
class RecoveryConfig:
    """Configure starts and acceptance thresholds."""

    rotation: RotationConfig = field(default_factory=RotationConfig)  # between the image and a keyframe
    align: AlignConfig = field(default_factory=lambda: AlignConfig(levels=(4, 2, 1), iterations=(10, 6, 5)))
    translation_std: float = 0.5  # m, of the pose around a start
    rotation_std: float = 0.5  # rad
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)  # of the ring that starts are taken from
    keyframes: int = 3  # most similar ones to start from
    min_score: float = 0.65  # a little above tracking's: a wrong place must not pass
    max_photometric: float = 4.0
    max_unexplained: float = 0.55  # of the image's contrast: 0.3 to 0.4 at the right place, 0.6 to 1.4 at wrong ones
    min_correlation: float = 0.8  # of the luminances of the image and the map
    max_std: float = 0.03  # m and rad: the image alone must fix every coordinate of the pose to this


class Attempt(eqx.Module):
    """Hold the best of several alignments."""

    T_world_cam: Float[Array, "4 4"]
    gain: Float[Array, ""]  # of the image: see :mod:`exposure`
    fit_quality: AlignInfo
    agreement: Agreement  # of the colours
    accepted: Bool[Array, ""]  # by itself: without a comparison with the others


def prior_precision(basis: Float[Array, "6 p"], config: RecoveryConfig) -> Float[Array, "p p"]:
    """Return the precision of a pose around a start, in the coordinates of the camera's twists ``basis``."""
    std = jnp.asarray([config.translation_std] * 3 + [config.rotation_std] * 3)
    return basis.T @ (basis * std[:, None] ** -2)


@partial(jax.jit, static_argnums=5)
def attempt(
    T_world_start: Float[Array, "4 4"],
    rendered: RGBD,
    image: RGBD,
    camera: Camera,
    basis: Float[Array, "6 p"],
    config: RecoveryConfig,
) -> Attempt:
    """Align an image to the map rendered at a start, and judge the result by itself.

    Args:
        T_world_start: The start.
        rendered: The map from there.
        image: The image.
        camera: Of both.
        basis: The twists (camera frame) along which the camera may move.
        config: Effort and thresholds.
    """
    # Match the brightness of the rendering where both are known; exact in the second call, at the right pose.
    brightness = gain(luminance(rendered.rgb), luminance(image.rgb), rendered.known)
    image = expose(image, brightness)
    identity, precision = jnp.eye(4), prior_precision(basis, config)
    T, info = gauss_newton.align(identity, precision, identity, basis, rendered, image, camera, config.align)
    # An image of low contrast differs little from any other. Below one sigma it carries no information.
    grey = luminance(image.rgb)
    contrast = jnp.mean(jnp.abs(grey - jnp.mean(grey))) / config.align.rgb_sigma
    limit = jnp.clip(config.max_unexplained * contrast, 1.0, config.max_photometric)
    accepted = (score(info) >= config.min_score) & (info.photometric <= limit)
    ref = make_reference(rendered, camera, config.align)
    obs = make_observed(image, camera, 1, stride(camera, 1, config.align))
    agrees = agreement(T, ref, obs, camera, 1, config.align)
    accepted &= agrees.correlation >= config.min_correlation
    accepted &= fixes_pose(T, basis, ref, obs, camera, config.align, config.max_std)
    return Attempt(T_world_start @ T, brightness, info, agrees, accepted)


def recover(
    m: VoxelMap,
    T_world_starts: Float[Array, "starts 4 4"],
    image: RGBD,
    camera: Camera,
    basis: Float[Array, "6 p"],
    max_depth: float,
    config: RecoveryConfig,
) -> Attempt:
    """Align to the map rendered at every start; return the best accepted alignment (eq. I32).

    Each start is aligned twice, the second time to a rendering at the first result, so that distant starts converge.

    Args:
        m: The map.
        T_world_starts: Poses to start from.
        image: The image, at tracking size.
        camera: Its intrinsics.
        basis: The twists (camera frame) along which the camera may move from a start.
        max_depth: Of the rendering, m.
        config: Effort and thresholds.
    """
    attempts = []
    for T_world_start in T_world_starts:
        rendered = emission.render(m, T_world_start, camera, max_depth)
        first = attempt(T_world_start, rendered, image, camera, basis, config)
        again = emission.render(m, first.T_world_cam, camera, max_depth)
        attempts.append(attempt(first.T_world_cam, again, image, camera, basis, config))
    every = jax.tree.map(lambda *leaves: jnp.stack(leaves), *attempts)
    found = _best(every)
    if found.accepted:
        rendered = emission.render(m, found.T_world_cam, camera, max_depth)
        found = eqx.tree_at(lambda a: a.accepted, found, confirmed(found, rendered, image, camera, basis, config))
    return found


def confirmed(
    found: Attempt, rendered: RGBD, image: RGBD, camera: Camera, basis: Float[Array, "6 p"], config: RecoveryConfig
) -> Bool[Array, ""]:
    """Return whether an accepted alignment fits at one scale of its depth (eq. I29) and at one place (eq. I33).

    Args:
        found: The alignment.
        rendered: The map from its pose.
        image: The image.
        camera: Of both.
        basis: The twists (camera frame) along which the camera may move.
        config: Scales of the alignment.
    """
    exposed, here = _expose(image, found.gain), jnp.eye(4)
    unscaled = fits_unscaled(here, basis, rendered, exposed, camera, config.align)
    return unscaled & is_unique(here, basis, rendered, exposed, camera, config.align)


_expose = jax.jit(expose)


@jax.jit
def _best(every: Attempt) -> Attempt:
    """Return the best attempt; it is accepted if no other place fits as well."""
    accepted = every.accepted
    best = jnp.argmax(accepted + jnp.nan_to_num(jax.vmap(score)(every.fit_quality)))
    apart = jax.vmap(se3_log)(inverse(every.T_world_cam[best]) @ every.T_world_cam)
    elsewhere = jnp.maximum(jnp.linalg.norm(apart[:, :3], axis=1), jnp.linalg.norm(apart[:, 3:], axis=1)) > APART
    rival = accepted & elsewhere & (every.agreement.cost <= every.agreement.cost[best] + COLOUR_MARGIN)
    found = jax.tree.map(lambda leaf: leaf[best], every)
    return eqx.tree_at(lambda a: a.accepted, found, accepted[best] & ~jnp.any(rival))
