"""``c(T exp(s d)) > c(T) + 0.1  or  rho(T exp(s d)) < rho(T) - 0.02``: no shifted pose fits as well (ours).

On a flat wall depth fixes three coordinates of six, and edges of the colour have to fix the others. A door whose other
jamb was never mapped, or one of several equal panels, fits at more than one place along the wall. Each of them is a
sharp minimum of the cost, so that the curvature at any one says that the pose is known.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_adjoint, se3_exp
from vssm_gym.inference.alignment.agreement import agreement
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    linearise,
    make_observed,
    make_reference,
    normal_equations,
    stride,
)
from vssm_gym.model.emission import RGBD

FACTOR = 2  # the images are shrunk by: neighbouring pixels show the same
APART = 0.1  # m and rad: poses that differ by more are different places
FARTHEST_SHIFT = 0.6  # m, or rad of a coordinate that is an angle
SHIFTS = np.linspace(-FARTHEST_SHIFT, FARTHEST_SHIFT, 61)  # m, or rad
CORRELATION_MARGIN = 0.02  # a place whose colours correlate less by that is as good
COLOUR_MARGIN = 0.1  # standard deviations of the luminance: a place whose colours fit worse by less is as good
MIN_SHARE = 0.5  # of the pixels that the pose itself has in common with the reference


@partial(jax.jit, static_argnums=5)
def is_unique(
    T: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    reference: RGBD,
    image: RGBD,
    camera: Camera,
    config: AlignConfig,
) -> Bool[Array, ""]:
    """Return False where a shifted pose is a minimum of the colours' cost, and fits as well (eq. I33).

    Each coordinate of the tangent is shifted in turn; the others follow as depth has them, ``d_k = S[:, k] / S[k, k]``
    with the covariance ``S`` that the geometry alone leaves.

    Args:
        T: T_ref_cam, an aligned pose.
        basis: the twists (camera frame) along which the camera may move.
        reference: RGB-D image at the reference pose.
        image: the image, at the reference's exposure.
        camera: intrinsics of both.
        config: scales of the alignment.
    """
    ref = make_reference(reference, camera, config, FACTOR)
    obs = make_observed(image, camera, FACTOR, stride(camera, FACTOR, config))
    geometry, *_ = linearise(T, ref, obs, camera, FACTOR, config)
    close = geometry.usable & (jnp.abs(geometry.residual) < config.inlier)
    H, _ = normal_equations(geometry._replace(weight=geometry.weight * close))
    twists = se3_adjoint(T) @ basis
    S = jnp.linalg.inv(twists.T @ H @ twists + jnp.eye(basis.shape[1]) / FARTHEST_SHIFT**2)
    directions = basis @ (S / jnp.diag(S))
    tried = (SHIFTS[:, None, None] * directions.T).reshape(-1, 6)
    every = jax.vmap(lambda twist: agreement(T @ se3_exp(twist), ref, obs, camera, FACTOR, config))(tried)
    lines = jax.tree.map(lambda values: values.reshape(len(SHIFTS), -1), every)
    here = jax.tree.map(lambda values: values[len(SHIFTS) // 2, 0], lines)
    cost = jnp.where(lines.share >= MIN_SHARE * here.share, lines.cost, jnp.inf)
    lowest = (cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:]) & (np.abs(SHIFTS[1:-1, None]) >= APART)
    as_good = (cost <= here.cost + COLOUR_MARGIN) & (lines.correlation >= here.correlation - CORRELATION_MARGIN)
    known = jnp.isfinite(here.cost) & jnp.isfinite(here.correlation)  # no comparison holds with NaN
    return known & ~jnp.any(lowest & as_good[1:-1])
