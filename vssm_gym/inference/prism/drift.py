"""``m <- (1 - nu) m + nu (d + Ad_T e)``: the drift of the map's frame around the camera (ours, beyond PRISM).

Alignment measures the pose against the map, and the map was itself placed by poses: what an image writes into the map
takes over the error ``e`` of its pose. The map's frame around the camera therefore moves by the share ``nu`` of the map
in view that this image wrote. The share is 1 in new space and 1/n where n images were taken before. The errors of
consecutive images are alike, because the same surfaces cause them, and add up: their covariances with each other are
kept (:mod:`~vssm_gym.inference.tracking.error_covariance`). The drift of a camera that stands still grows with the
logarithm of time. Revisiting a place does not reduce it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD


@jax.jit
def precision(m: VoxelMap, T_world_cam: Float[Array, "4 4"], image: RGBD, camera: Camera) -> Float[Array, "readings"]:
    """Return ``lambda`` of the map's occupancy (1/m^2) at the image's readings, of every fourth row and column."""
    p_cam = camera.backproject(image.depth)[2::4, 2::4].reshape(-1, 3)
    return m.precision(p_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])[:, 0]


@jax.jit
def share(before: Float[Array, "readings"], after: Float[Array, "readings"], image: RGBD) -> Float[Array, ""]:
    """``nu = mean((lambda_t - lambda_t-1) / lambda_t)``: the share of the map in view that the image wrote (eq. I23).

    Args:
        before: :func:`precision` of the map before the image entered it.
        after: And after that.
        image: The image.
    """
    read = image.hit[2::4, 2::4].reshape(-1)
    return jnp.sum(read * (1.0 - before / after)) / jnp.maximum(jnp.sum(read), 1)
