"""Propagate map uncertainty to images: ``p(x | z) = int p(x | z, M) q(M) dM``, to first order or by samples.

The std of a surface's place is :func:`~vssm_gym.maps.surface_std.surface_std`; samples of the map are drawn by
:func:`~vssm_gym.model.map_samples.sample_map`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.surface_std import differences, surface_std
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, RGBD, STEP, render, world_rays
from vssm_gym.model.map_samples import MEASUREMENT_NOISE, MeasurementNoise, sample_map

MIN_COSINE = 0.1  # of a ray's incidence, so that a ray that grazes a surface magnifies errors tenfold at most


@jax.jit
def image_std(
    m: VoxelMap,
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    image: RGBD,
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE,
) -> tuple[Float[Array, "height width"], Float[Array, "height width 3"]]:
    """Return the std of a rendered image under ``q(M)``, to first order at the hit (eq. M13).

    A surface that moves by ``e`` along its normal ``n`` changes the z-depth along a ray ``c + d r`` by ``e / (n . r)``:
    ``std d = std(p) / |n . r|``. Colour varies by its own noise and by its change along the ray. The errors of
    a map at estimated poses are not part of it: they move the map as a whole, and its samples hold them.

    Args:
        m: The map belief.
        T_world_cam: Camera pose.
        camera: Intrinsics and image size.
        image: What :func:`vssm_gym.model.emission.render` gives for them.
        measurement_noise: Std of one observation.

    Returns:
        Depth std (m) and colour std; infinite where the image is not ``known``.
    """
    centre, directions = world_rays(T_world_cam, camera)
    depth = image.depth.reshape(-1)
    at = lambda d: jnp.stack([centre[a] + directions[:, a] * d for a in range(3)], axis=-1)
    hit, e = at(depth), STEP * m.voxel_size
    _, gradient, _ = differences(m, hit)
    steepest = jnp.linalg.norm(gradient, axis=-1) * jnp.linalg.norm(directions, axis=-1)
    cosine = jnp.abs(jnp.sum(gradient * directions, axis=-1)) / jnp.maximum(steepest, 1e-9)
    along = jnp.maximum(cosine, MIN_COSINE) * jnp.linalg.norm(directions, axis=-1)  # n . r
    depth_variance = (surface_std(m, hit, measurement_noise.reading_std) / along) ** 2
    colour_slope = (m.colour_at(at(depth + 0.5 * e)) - m.colour_at(at(depth - 0.5 * e))) / e
    colour_variance = measurement_noise.colour_std(m.precision(hit)[..., 1]) ** 2
    rgb_variance = colour_variance[:, None] + colour_slope**2 * depth_variance[:, None]
    shape = (camera.height, camera.width)
    depth_std = jnp.where(image.known, jnp.sqrt(depth_variance).reshape(shape), jnp.inf)
    rgb_std = jnp.where(image.known[..., None], jnp.sqrt(rgb_variance).reshape(*shape, 3), jnp.inf)
    return depth_std, rgb_std


@partial(jax.jit, static_argnames="samples")
def sample_images(
    key: PRNGKeyArray,
    m: VoxelMap,
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    samples: int,
    max_depth: float | Array = MAX_DEPTH,
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE,
) -> RGBD:
    """Render ``mu_rgbd(z, M_k)``, ``M_k ~ q(M)``: the same view of ``samples`` maps, one after the other (eq. M14).

    Returns:
        An image whose arrays have ``samples`` as first axis.
    """
    views = lambda k: render(sample_map(k, m, measurement_noise), T_world_cam, camera, max_depth)
    return jax.lax.map(views, jax.random.split(key, samples))
