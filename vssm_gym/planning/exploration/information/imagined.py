"""Imagine images from the current belief: depth of many views in one call, at the map's mean or in a sample (eq. P36).

Literal samples of unknown cells, ``N(-0.001, 10^2)`` each on its own, are solid by the next cell: no ray would enter
the unknown. The prior has no correlation between cells, so samples use another model: unknown space holds random
obstacles, one cell wide, with the density of a given mean free path of rays.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.map_samples import MeasurementNoise, sample_map

SHADOW = 5.0  # voxels^2 that an occupied cell among free ones hides: 4 from a ray along an axis, up to 6 from others
VIEWS_AT_ONCE = 16  # views per call of the renderer: with 1200 pixels per view as many rays as one image of 160 x 120


def imagine(m: VoxelMap, T_world_cam: np.ndarray, camera: Camera, max_depth: float) -> np.ndarray:
    """Return ``mu_depth(z, E[M])`` of every view, ``max_depth`` where a ray meets no surface.

    Unknown space is just free at the prior's mean, so a view of it is optimistic: in the image all of it is free, as
    far as the camera sees. Without a measurement there, unknown space would have no value.

    Args:
        m: map belief.
        T_world_cam: ``(views, 4, 4)`` camera poses.
        camera: of the imagined images.
        max_depth: z-depth, m, up to which the camera sees.

    Returns:
        ``(views, height, width)`` z-depth, m, float32.
    """
    views = len(T_world_cam)
    padded = np.concatenate([T_world_cam, np.repeat(T_world_cam[:1], -views % VIEWS_AT_ONCE, axis=0)])
    batches = padded.astype(np.float32).reshape(
        -1, VIEWS_AT_ONCE, 4, 4
    )  # by NumPy: JAX would compile this for each length
    images = [np.asarray(_depths(m, T, camera, max_depth)) for T in batches]
    return np.concatenate(images)[:views]


@jax.jit
def _depths(m: VoxelMap, T_world_cam: Float[Array, "batch 4 4"], camera: Camera, max_depth: float) -> Array:
    return jax.vmap(partial(_depth, m, camera=camera, max_depth=max_depth))(T_world_cam)


def _depth(m: VoxelMap, T_world_cam: Array, camera: Camera, max_depth: float | Array) -> Array:
    centre, directions = emission.world_rays(T_world_cam, camera)
    k, hit = emission.search(m, centre, directions, max_depth)
    depth = emission.intersect(m, centre, directions, jnp.where(hit, k, 2))
    return jnp.where(hit, jnp.minimum(depth, max_depth), max_depth).reshape(camera.height, camera.width)


def draw(seed: int, m: VoxelMap, mean_free_path: float, std: float) -> VoxelMap:
    """Draw ``M ~ q(M)``: observed cells by :func:`~.map_samples.sample_map`, others at random.

    An unknown cell is occupied with probability ``1 - exp(-voxel / (SHADOW mean_free_path))``, so that rays survive
    ``d`` metres of unknown space with about ``exp(-d / mean_free_path)``.

    Args:
        seed: of the sample.
        m: map belief.
        mean_free_path: of a ray in unknown space, m.
        std: of the map update.

    Raises:
        InputError: a block-sparse map, whose unknown blocks have no cells to draw.
    """
    if m.table is not None:
        raise InputError("InformationConfig", "samples", "0, the mean, for a block-sparse map")
    return _draw(jax.random.PRNGKey(seed), m, mean_free_path, MeasurementNoise(counted=std))


@jax.jit
def _draw(key: Array, m: VoxelMap, mean_free_path: float, measurement_noise: MeasurementNoise) -> VoxelMap:
    by_known, by_unknown = jax.random.split(key)
    sampled = sample_map(by_known, m, measurement_noise)
    chance = 1.0 - jnp.exp(-m.voxel_size / (SHADOW * mean_free_path))
    obstacle = (m.occupancy_precision < OBSERVED_PRECISION) & (
        jax.random.uniform(by_unknown, m.occupancy.shape) < chance
    )
    return m.with_occupancy(jnp.where(obstacle, m.voxel_size, sampled.occupancy))
