"""Estimate the pose by MAP with robust Gauss-Newton: ``argmin_T L_geo + L_rgb - log q(T)`` (PRISM, step 2).

Huber's function is the published L1 norm beyond its elbow and quadratic below it, where Gauss-Newton needs a
curvature; coarse to fine over image levels.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp, se3_log
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    AlignInfo,
    fit_quality,
    linearise,
    make_observed,
    make_reference,
    normal_equations,
    stride,
)
from vssm_gym.model.emission import RGBD


def align(
    T_prior: Float[Array, "4 4"],
    prior_precision: Float[Array, "dof dof"],
    T_start: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    reference: RGBD,
    observed: RGBD,
    camera: Camera,
    config: AlignConfig,
    seen: Float[Array, "height width"] | None = None,
    spread: Float[Array, "height width"] | None = None,
) -> tuple[Float[Array, "4 4"], AlignInfo]:
    """``argmin_xi  sum rho(r_geo) + rho(r_rgb) + 1/2 xi^T P xi``, ``T_ref_cam = T_prior exp(B xi)`` (eqs. I6 and I11).

    Args:
        T_prior: Mean of the prior on T_ref_cam.
        prior_precision: P, in the basis' coordinates.
        T_start: Where the search begins; differs from ``T_prior`` by a motion inside the basis.
        basis: B, the twists (translation, rotation; camera frame) the camera may move along.
        reference: RGB-D image at the reference pose.
        observed: RGB-D image at the unknown pose.
        camera: Intrinsics of both.
        config: Scales, gates, effort.
        seen: Luminance of the camera image taken at the reference pose, if any.
        spread: Std of the reference's depth, m, where it is a belief.

    Returns:
        T_ref_cam at the optimum, and its fit quality.
    """
    coordinates = jnp.linalg.pinv(basis)
    T_inverse_prior = inverse(T_prior)

    def solve_level(T, factor, iterations):
        ref = make_reference(reference, camera, config, factor, seen, spread)
        obs = make_observed(observed, camera, factor, stride(camera, factor, config))

        def step(carry):
            T, _, count = carry
            H, gradient = normal_equations(*linearise(T, ref, obs, camera, factor, config))
            xi = coordinates @ se3_log(T_inverse_prior @ T)
            twists = se3_adjoint(T) @ basis  # T exp(B xi) = exp(Ad_T B xi) T
            H = twists.T @ H @ twists + prior_precision
            gradient = twists.T @ gradient + prior_precision @ xi
            # Weak damping, far below any real information, keeps unobserved directions (zero rows) finite.
            delta = -jnp.linalg.solve(H + 1e-6 * jnp.eye(H.shape[0]) * (1.0 + jnp.trace(H)), gradient)
            return T @ se3_exp(basis @ delta), jnp.max(jnp.abs(delta)), count + 1

        def unfinished(carry):
            return (carry[2] < iterations) & (carry[1] > config.tolerance)

        T, _, count = jax.lax.while_loop(unfinished, step, (T, jnp.inf, 0))
        return T, count, ref, obs

    T = T_start
    for factor, iterations in zip(config.levels, config.iterations, strict=True):
        T, count, ref, obs = solve_level(T, factor, iterations)
    if factor != 1:
        ref = make_reference(reference, camera, config, 1, seen, spread)
        obs = make_observed(observed, camera, 1, stride(camera, 1, config))
    return T, fit_quality(T, basis, ref, obs, camera, config, count)
