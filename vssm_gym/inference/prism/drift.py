"""Drift: alignment tells the pose against the map, and the map itself was placed by poses (ours, beyond PRISM).

What an image writes into the map stands as uncertain in the world as its own pose does. The map's frame around the
camera therefore walks at random, ``P <- P + k nu Ad_T Sigma Ad_T^T``, by the share ``nu`` of what the camera sees that
this image wrote: of the precision of the map where its readings lie, ``nu = mean((lambda_t - lambda_t-1) / lambda_t)``.
That is 1 in new space and 1/n where n images were before, so a camera that stands still soon walks no more, and no
revisit makes the walk smaller either. ``k`` says how many images in a row err alike, because they were aligned to one
anchor. It stands in for the correlation between pose and map that the two marginal filters leave out.
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

ALIKE = 16.0  # k; simulated walks ask for 4, a real Kinect, whose depth errs alike everywhere, for 100


@jax.jit
def precision(m: VoxelMap, T_world_cam: Float[Array, "4 4"], image: RGBD, camera: Camera) -> Float[Array, "readings"]:
    """``lambda`` of the map's occupancy (1/m^2) where the image's readings lie, of every fourth row and column."""
    p_cam = camera.backproject(image.depth)[2::4, 2::4].reshape(-1, 3)
    return m.precision(p_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])[:, 0]


@jax.jit
def grow(
    drift: Float[Array, "6 6"],
    before: Float[Array, "readings"],
    after: Float[Array, "readings"],
    relative: GaussianBelief,
    image: RGBD,
) -> Float[Array, "6 6"]:
    """``P + k nu Ad_T Sigma Ad_T^T``, ``nu`` the share of the map in view that the image wrote.

    Args:
        drift: P, covariance of the map's frame in the world, in the world's tangent.
        before: :func:`precision` of the map before the image entered it.
        after: And after that.
        relative: The belief against the map; Sigma is its pose covariance.
        image: The image.
    """
    read = image.hit[2::4, 2::4].reshape(-1)
    share = jnp.sum(read * (1.0 - before / after)) / jnp.maximum(jnp.sum(read), 1)
    twists = relative.manifold.twists
    p = twists.shape[1]
    carry = se3_adjoint(relative.manifold.pose(relative.mean)) @ twists
    return drift + ALIKE * share * carry @ relative.covariance[:p, :p] @ carry.T


@jax.jit
def in_world(relative: GaussianBelief, drift: Float[Array, "6 6"]) -> GaussianBelief:
    """The belief against the map as one in the world: ``Sigma + Ad_T^-1 P Ad_T^-T``."""
    twists = relative.manifold.twists
    p = twists.shape[1]
    # Of a robot on a floor only the drift within the floor's plane matters: twists are orthonormal.
    carry = twists.T @ se3_adjoint(inverse(relative.manifold.pose(relative.mean)))
    return eqx.tree_at(lambda q: q.covariance, relative, relative.covariance.at[:p, :p].add(carry @ drift @ carry.T))
