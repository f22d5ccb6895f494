"""Drift: alignment tells the pose against the map, and the map itself was placed by poses (ours, beyond PRISM).

What an image adds to the map stands as uncertain in the world as its own pose does. The map's frame around the camera
therefore walks at random, ``P <- P + k nu Ad_T Sigma Ad_T^T``, by the share ``nu`` of the image that is new; ``k`` says
how many images in a row err alike, because they were aligned to one anchor. The walk is that of new space: while the
camera looks at what it knows, nothing is added, and no revisit makes it smaller either. It stands in for the
correlation between pose and map that the two marginal filters leave out.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.camera import Camera
from vssm_gym.emission import KNOWN_SHARE, RGBD
from vssm_gym.geometry import inverse, se3_adjoint
from vssm_gym.transition.rigid import RigidBelief
from vssm_gym.voxel_map import VoxelMap

ALIKE = 8.0  # k; fitted to three walks through one simulated apartment, and within 1.6 of right in two others


@jax.jit
def grow(
    drift: Float[Array, "6 6"], m: VoxelMap, relative: RigidBelief, image: RGBD, camera: Camera
) -> Float[Array, "6 6"]:
    """``P + k nu Ad_T Sigma Ad_T^T``, ``nu`` the share of the image's readings where the map has seen nothing yet.

    Args:
        drift: P, covariance of the map's frame in the world, in the world's tangent.
        m: The map before the image enters it.
        relative: The belief against the map; Sigma is its pose covariance.
        image: The image.
        camera: Its intrinsics.
    """
    p_cam = camera.backproject(image.depth)[2::4, 2::4].reshape(-1, 3)
    T = relative.state.T_world_body
    read = image.hit[2::4, 2::4].reshape(-1)
    unseen = m.observed_at(p_cam @ T[:3, :3].T + T[:3, 3]) < KNOWN_SHARE
    share = jnp.sum(unseen & read) / jnp.maximum(jnp.sum(read), 1)
    carry = se3_adjoint(T)
    return drift + ALIKE * share * carry @ relative.covariance[:6, :6] @ carry.T


@jax.jit
def in_world(relative: RigidBelief, drift: Float[Array, "6 6"]) -> RigidBelief:
    """The belief against the map as one in the world: ``Sigma + Ad_T^-1 P Ad_T^-T``."""
    carry = se3_adjoint(inverse(relative.state.T_world_body))
    return RigidBelief(relative.state, relative.covariance.at[:6, :6].add(carry @ drift @ carry.T))
