"""``P <- P + k nu Ad_T Sigma Ad_T^T``: the drift of the map's frame around the camera (ours, beyond PRISM).

Alignment measures the pose against the map, and the map was itself placed by poses: what an image writes into the map
inherits the uncertainty of its pose in the world. The map's frame around the camera therefore does a random walk, in
proportion to the share ``nu`` of the map in view that this image wrote, in units of precision at its readings:
``nu = mean((lambda_t - lambda_t-1) / lambda_t)``. The share is 1 in new space and 1/n where n images were taken before.
A camera that stands still soon stops drifting, and revisiting a place does not reduce the drift. ``k`` is the number of
consecutive images whose errors are alike, because they were aligned to one reference view. The model replaces the
correlation between pose and map that the two marginal filters neglect.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_adjoint
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition.belief import GaussianBelief


@jax.jit
def precision(m: VoxelMap, T_world_cam: Float[Array, "4 4"], image: RGBD, camera: Camera) -> Float[Array, "readings"]:
    """Return ``lambda`` of the map's occupancy (1/m^2) at the image's readings, of every fourth row and column."""
    p_cam = camera.backproject(image.depth)[2::4, 2::4].reshape(-1, 3)
    return m.precision(p_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])[:, 0]


@jax.jit
def grow(
    drift: Float[Array, "6 6"],
    before: Float[Array, "readings"],
    after: Float[Array, "readings"],
    relative: GaussianBelief,
    image: RGBD,
    correlated_images: float | Array,
) -> Float[Array, "6 6"]:
    """``P + k nu Ad_T Sigma Ad_T^T``, ``nu`` the share of the map in view that the image wrote (eq. I23).

    Args:
        drift: P, covariance of the map's frame in the world, in the world's tangent.
        before: :func:`precision` of the map before the image entered it.
        after: And after that.
        relative: The belief against the map; Sigma is its pose covariance.
        image: The image.
        correlated_images: k, the number of consecutive images whose errors are alike.
    """
    read = image.hit[2::4, 2::4].reshape(-1)
    share = jnp.sum(read * (1.0 - before / after)) / jnp.maximum(jnp.sum(read), 1)
    twists = relative.manifold.twists
    p = twists.shape[1]
    carry = se3_adjoint(relative.manifold.pose(relative.mean)) @ twists
    return drift + correlated_images * share * carry @ relative.covariance[:p, :p] @ carry.T


@jax.jit
def in_world(relative: GaussianBelief, drift: Float[Array, "6 6"]) -> GaussianBelief:
    """``Sigma + Ad_T^-1 P Ad_T^-T``: the belief in the world, from the belief against the map (eq. I24)."""
    twists = relative.manifold.twists
    p = twists.shape[1]
    # For a robot on a floor only drift within the floor's plane matters: twists are orthonormal.
    carry = twists.T @ se3_adjoint(inverse(relative.manifold.pose(relative.mean)))
    return eqx.tree_at(lambda q: q.covariance, relative, relative.covariance.at[:p, :p].add(carry @ drift @ carry.T))
