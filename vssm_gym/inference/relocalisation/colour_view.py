"""Align a map to an image of colours alone: where was a picture taken that has no depth?

The roles of an alignment are exchanged. The view rendered at a candidate has depth and takes the role of the observed
image; the picture takes that of the reference, whose planes are unknown, so that only the photometric residual of
eq. I8 remains. Each round renders the map at the pose of the round before.
"""

from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.agreement import Agreement, agreement
from vssm_gym.inference.alignment.exposure import gain
from vssm_gym.inference.alignment.residuals import AlignConfig, luminance, make_observed, make_reference, stride
from vssm_gym.inference.relocalisation.refinement import Refined, render_all
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD, render
from vssm_gym.model.emission_density import EmissionScales, log_prob


@dataclass(frozen=True)
class ColourViewConfig:
    """Configure the photometric alignment; coarse to fine over its rounds."""

    width: int = 80  # pixels, to about which the picture is shrunk
    rounds: tuple[AlignConfig, ...] = field(
        default_factory=lambda: (
            AlignConfig(rgb_sigma=0.08, rgb_gate=0.6, rgb_weight=1.0, levels=(4,), iterations=(12,)),
            AlignConfig(rgb_sigma=0.06, rgb_gate=0.5, rgb_weight=1.0, levels=(4, 2), iterations=(8, 8)),
            AlignConfig(rgb_sigma=0.04, rgb_weight=1.0, levels=(2, 1), iterations=(8, 6)),
            AlignConfig(rgb_sigma=0.04, rgb_weight=1.0, levels=(1,), iterations=(8,)),
        )
    )
    translation_std: float = 0.3  # m, of the pose around the start of a round
    rotation_std: float = 0.2  # rad


def _precision(basis: Array, config: ColourViewConfig) -> Array:
    std = jnp.asarray([config.translation_std] * 3 + [config.rotation_std] * 3)
    return basis.T @ (basis * std[:, None] ** -2)


@partial(jax.jit, static_argnums=(5, 6))
def _align(
    T_world_cam: Array,
    rendered: RGBD,
    rgb: Array,
    camera: Camera,
    basis: Array,
    align: AlignConfig,
    config: ColourViewConfig,
) -> Array:
    precision = _precision(basis, config)

    def one(given):
        T, view = given
        brightness = gain(luminance(rgb), luminance(view.rgb), view.known)
        seen = eqx.tree_at(lambda v: (v.rgb, v.hit), view, (jnp.clip(brightness * view.rgb, 0.0, 1.0), view.known))
        here, nothing = jnp.eye(4), jnp.zeros(rgb.shape[:2])
        picture = RGBD(nothing, rgb, nothing > 0.0, nothing == 0.0)
        T_picture_view, _ = gauss_newton.align(here, precision, here, basis, picture, seen, camera, align)
        return T @ inverse(T_picture_view)

    return jax.lax.map(one, (T_world_cam, rendered))


@jax.jit
def _weigh(rendered: RGBD, rgb: Array, scales: EmissionScales) -> tuple[Array, Array]:
    def one(view):
        brightness = gain(luminance(view.rgb), luminance(rgb), view.known)
        picture = RGBD(view.depth, jnp.clip(brightness * rgb, 0.0, 1.0), view.hit, view.known)
        return brightness, jnp.mean(log_prob(picture, view, scales).rgb)

    return jax.vmap(one)(rendered)


@partial(jax.jit, static_argnums=(5,))
def picture_agreement(
    image: RGBD,
    rgb: Float[Array, "height width 3"],
    T_picture_image: Float[Array, "4 4"],
    camera: Camera,
    basis: Float[Array, "6 p"],
    config: ColourViewConfig,
) -> Agreement:
    """Align a camera image, which has depth, to a picture that it may show in part, and compare their colours.

    Args:
        image: the camera image.
        rgb: the picture, of the same size, in [0, 1].
        T_picture_image: where the camera is believed to be, in the frame of the picture's camera.
        camera: intrinsics of both.
        basis: twists (camera frame) along which the camera may move.
        config: effort; the start's errors are taken to be as large as those of a candidate.
    """
    nothing = jnp.zeros(rgb.shape[:2])
    picture, T = RGBD(nothing, rgb, nothing > 0.0, nothing == 0.0), T_picture_image
    precision = _precision(basis, config)
    for align in config.rounds:
        T, _ = gauss_newton.align(T_picture_image, precision, T, basis, picture, image, camera, align)
    last = config.rounds[-1]
    return agreement(
        T,
        make_reference(picture, camera, last),
        make_observed(image, camera, 1, stride(camera, 1, last)),
        camera,
        1,
        last,
    )


def align_views(
    m: VoxelMap,
    T_world_cam: Float[Array, "n 4 4"],
    rgb: Float[Array, "height width 3"],
    camera: Camera,
    basis: Float[Array, "6 p"],
    max_depth: float,
    config: ColourViewConfig,
    scales: EmissionScales,
) -> Refined:
    """Align the map to a picture from every candidate, and weigh the results by ``log p(rgb | z, M)``.

    Args:
        m: the map.
        T_world_cam: candidates; their number is part of what is compiled.
        rgb: the picture, shrunk, in [0, 1].
        camera: its intrinsics.
        basis: twists (camera frame) along which the camera may move.
        max_depth: of the rendering, m.
        config: effort.
        scales: of the emission.
    """
    T = T_world_cam
    for align in config.rounds:
        T = _align(T, render_all(m, T, camera, max_depth), rgb, camera, basis, align, config)
    brightness, log_probs = _weigh(render_all(m, T, camera, max_depth), rgb, scales)
    return Refined(T, brightness, log_probs)


@jax.jit
def view_agreement(
    m: VoxelMap,
    T_world_cam: Float[Array, "n 4 4"],
    rgb: Float[Array, "height width 3"],
    camera: Camera,
    max_depth: float | Array,
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Compare a picture with the map seen from poses: the correlation of their luminances, and the share compared.

    Args:
        m: the map.
        T_world_cam: of the picture's camera.
        rgb: the picture, in [0, 1].
        camera: its intrinsics.
        max_depth: of the rendering, m.

    Returns:
        ``rho`` over the pixels where the map shows an observed surface, 0 where it has no contrast; and their share.
    """
    picture = luminance(rgb)

    def one(T):
        view = render(m, T, camera, max_depth)
        weight = view.known / jnp.maximum(jnp.sum(view.known), 1)
        a, b = (x - jnp.sum(weight * x) for x in (picture, luminance(view.rgb)))
        spread = jnp.sqrt(jnp.sum(weight * a * a) * jnp.sum(weight * b * b))
        return jnp.sum(weight * a * b) / jnp.maximum(spread, 1e-6), jnp.mean(view.known)

    return jax.lax.map(one, T_world_cam)
