"""Refine candidate poses: align an image to the map rendered at each, and weigh the results by the model's likelihood.

All candidates are rendered by one compiled call and aligned by another, at a reduced image size. Each is aligned twice,
the second time to the map rendered at the first result, so that distant starts converge (eq. I32).
"""

from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.exposure import expose, gain
from vssm_gym.inference.alignment.residuals import AlignConfig, luminance
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob


@dataclass(frozen=True)
class RefinementConfig:
    """Configure the alignment of candidates."""

    width: int = 80  # pixels, to about which images are shrunk
    align: AlignConfig = field(
        default_factory=lambda: AlignConfig(geo_sigma=0.012, levels=(4, 2, 1), iterations=(8, 5, 4), pixels=1500)
    )
    translation_std: float = 0.3  # m, of the pose around a candidate
    rotation_std: float = 0.2  # rad


class Refined(eqx.Module):
    """Hold aligned candidates."""

    T_world_cam: Float[Array, "n 4 4"]
    gain: Float[Array, "n"]  # of the image: see :mod:`vssm_gym.inference.alignment.exposure`
    log_prob: Float[Array, "n"]  # mean of a pixel, nats: ``log p(x | z, M)``


@jax.jit
def render_all(m: VoxelMap, T_world_cam: Float[Array, "n 4 4"], camera: Camera, max_depth: float | Array) -> RGBD:
    """Render the map from several poses, one after the other: images with leading axis ``n``."""
    return jax.lax.map(lambda T: emission.render(m, T, camera, max_depth), T_world_cam)


@partial(jax.jit, static_argnums=5)
def _align(
    T_world_cam: Array, rendered: RGBD, image: RGBD, camera: Camera, basis: Array, config: RefinementConfig
) -> Array:
    std = jnp.asarray([config.translation_std] * 3 + [config.rotation_std] * 3)
    precision = basis.T @ (basis * std[:, None] ** -2)

    def one(given):
        T, view = given
        exposed = expose(image, gain(luminance(view.rgb), luminance(image.rgb), view.known))
        here = jnp.eye(4)
        return T @ gauss_newton.align(here, precision, here, basis, view, exposed, camera, config.align)[0]

    return jax.lax.map(one, (T_world_cam, rendered))


@jax.jit
def _weigh(rendered: RGBD, image: RGBD, scales: EmissionScales, max_depth: float | Array) -> tuple[Array, Array]:
    def one(view):
        brightness = gain(luminance(view.rgb), luminance(image.rgb), view.known & image.hit)
        return brightness, jnp.mean(log_prob(expose(image, brightness), view, scales, max_depth).total)

    return jax.vmap(one)(rendered)


def refine(
    m: VoxelMap,
    T_world_cam: Float[Array, "n 4 4"],
    image: RGBD,
    camera: Camera,
    basis: Float[Array, "6 p"],
    max_depth: float,
    config: RefinementConfig,
    scales: EmissionScales,
) -> Refined:
    """Align an image to the map from every candidate.

    Args:
        m: the map.
        T_world_cam: candidates; their number is part of what is compiled.
        image: shrunk.
        camera: its intrinsics.
        basis: twists (camera frame) along which the camera may move.
        max_depth: of the rendering, m.
        config: effort.
        scales: of the emission.
    """
    T = T_world_cam
    rendered = render_all(m, T, camera, max_depth)
    for _ in range(2):
        T = _align(T, rendered, image, camera, basis, config)
        rendered = render_all(m, T, camera, max_depth)
    brightness, log_probs = _weigh(rendered, image, scales, max_depth)
    return Refined(T, brightness, log_probs)
