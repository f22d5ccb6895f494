"""Images imagined from the current belief: depth rendered at the map's mean, many views in one call (SPEC 8)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym import emission
from vssm_gym.camera import Camera
from vssm_gym.voxel_map import VoxelMap

AT_ONCE = 16  # views a call of the renderer: as many rays as one 160x120 image has, with 1200 pixels a view


def imagine(m: VoxelMap, T_world_cam: np.ndarray, camera: Camera, max_depth: float) -> np.ndarray:
    """``mu_depth(z, E[M])`` of every view; a ray that meets no surface reads ``max_depth``.

    Unknown space is just free at the prior's mean, so a view of it is optimistic: the image says that all of it, as
    far as the camera sees, is free. No reading instead would make what nobody has seen worth nothing.

    Args:
        m: map belief.
        T_world_cam: ``(views, 4, 4)`` camera poses.
        camera: of the imagined images.
        max_depth: z-depth, m, up to which the camera sees.

    Returns:
        ``(views, height, width)`` z-depth, m, float32.
    """
    views = len(T_world_cam)
    padded = np.concatenate([T_world_cam, np.repeat(T_world_cam[:1], -views % AT_ONCE, axis=0)])
    batches = jnp.asarray(padded, jnp.float32).reshape(-1, AT_ONCE, 4, 4)
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
