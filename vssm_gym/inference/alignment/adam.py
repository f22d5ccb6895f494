"""Estimate the pose by MAP as published: ``argmin_T L_geo + L_rgb - log q(T)`` by Adam on few random pixels (PRISM).

With ``T = T_prior exp(B xi)`` and projective association, the loss of a step is over 200 newly drawn pixels,

    L(xi) = sum_k |<p^_k - T p_k, n^_k>| / s_geo + |x^[pi(T p_k)] - x[pi(p_k)]|_1 / s_rgb + 1/2 xi^T P xi

and Adam without momentum divides its gradient by the root of the gradient's running mean square. The sum over the drawn
pixels is not scaled up to the whole image: errors of neighbouring pixels are correlated, and about 200 pixels of an
image are independent.

:mod:`vssm_gym.inference.alignment.gauss_newton` solves the same problem faster; this solver is for comparison.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_exp, se3_log
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    AlignInfo,
    ObservedPixels,
    ReferencePixels,
    fit_quality,
    make_observed,
    make_reference,
    stride,
)
from vssm_gym.model.emission import RGBD

EPSILON = 1e-8  # of Adam (Kingma and Ba, ICLR 2015)


@dataclass(frozen=True)
class AdamConfig:
    """Configure the solver with the published scales, gates and effort."""

    geo_scale: float = 0.02  # s_geo, m
    rgb_scale: float = 0.1  # s_rgb, of one colour channel in [0, 1]
    geo_gate: float = 0.45  # m; pixels with a larger geometric error are left out
    rgb_gate: float = 0.15  # of luminance; likewise
    steps: int = 1000
    pixels: int = 200  # drawn a step
    translation_step: float = 0.001  # m
    rotation_step: float = 0.00036  # rad
    decay: float = 0.999  # beta2, of the gradient's mean square; beta1 is 0
    averaged: float = 0.25  # share of the iterations, the last ones, whose mean is the result; ours, see minimise


def _rows(ref: ReferencePixels, obs: ObservedPixels) -> tuple[Array, Array, Array, Array]:
    """Stack the values of each pixel of reference and observation, so that one gather reads them all.

    Returns:
        ``(pixels, 9)`` reference rows (plane, image, textured, spread), ``(pixels, 4)`` observed rows (point,
        luminance), the observed pixels that can be used, first in a list as long as the image, and how many they are.
    """
    textured = ref.textured.astype(ref.image.dtype)
    spread = jnp.zeros_like(textured) if ref.spread is None else ref.spread
    reference = jnp.concatenate([ref.plane, ref.image, textured[None], spread[None]]).T
    observed = jnp.concatenate([obs.points, obs.luminance[None]]).T
    (usable,) = jnp.nonzero(obs.valid, size=obs.valid.shape[0], fill_value=0)
    return reference, observed, usable, jnp.sum(obs.valid)


def data_loss(
    T: Float[Array, "4 4"], reference: Array, observed: Array, camera: Camera, config: AdamConfig
) -> Float[Array, ""]:
    """``sum_k |r_geo| / hypot(s_geo, spread) + |r_rgb|_1 / s_rgb`` over observed rows ``(n, 4)``, gated (eq. I12).

    Rows are those of :func:`_rows`.

    The image is luminance, as in all solvers here. The residual of a channel is approximated by luminance's, so that
    the L1 norm over the three channels is three times it. Association and gates are constants to the gradient.
    """
    p = observed.T
    q = [T[i, 0] * p[0] + T[i, 1] * p[1] + T[i, 2] * p[2] + T[i, 3] for i in range(3)]
    ahead = q[2] > 0.05
    inverse_z = 1.0 / jnp.where(ahead, q[2], 1.0)
    u, v = q[0] * inverse_z * camera.fx + camera.cx, q[1] * inverse_z * camera.fy + camera.cy
    i, j = (jnp.round(jax.lax.stop_gradient(a)) for a in (u, v))
    inside = ahead & (i >= 0) & (i < camera.width) & (j >= 0) & (j < camera.height)
    pixel = jnp.where(inside, j * camera.width + i, 0.0).astype(jnp.int32)
    nx, ny, nz, offset, grey, du, dv, textured, spread = reference.at[pixel].get(mode="promise_in_bounds").T
    r_geo = jnp.abs(offset - (nx * q[0] + ny * q[1] + nz * q[2]))
    r_rgb = jnp.abs(grey + du * (u - i) + dv * (v - j) - p[3])
    near = inside & (r_geo < config.geo_gate) & (nx * nx + ny * ny + nz * nz > 0.5)
    alike = near & (textured > 0.5) & (r_rgb < config.rgb_gate)
    return jnp.sum(near * r_geo / jnp.hypot(config.geo_scale, spread)) + 3.0 * jnp.sum(alike * r_rgb) / config.rgb_scale


def minimise(
    loss: Callable[[Array, Array], Array], xi: Float[Array, "dof"], basis: Float[Array, "6 dof"], config: AdamConfig
) -> Float[Array, "dof"]:
    """Minimise ``loss(xi, i)`` by Adam without momentum, i the number of the step (eq. I12).

    Return the mean of the last iterates.

    The last iterate of a stochastic descent fluctuates by its step size; the mean of the last quarter, our addition,
    hardly does.

    Args:
        loss: Noisy loss of a motion ``exp(B xi)``.
        xi: Start.
        basis: B; a coordinate that turns the camera gets the step size of rotations, even if it also translates.
        config: Steps.
    """
    turns = jnp.sum(basis[3:] ** 2, axis=0) > 1e-6
    size = jnp.where(turns, config.rotation_step, config.translation_step)
    first = int(config.steps * (1.0 - config.averaged))

    def step(i, carry):
        xi, square, total = carry
        g = jax.grad(loss)(xi, i)
        square = config.decay * square + (1.0 - config.decay) * g * g
        rms = jnp.sqrt(square / (1.0 - config.decay ** (i + 1.0)))
        xi = xi - size * g / (rms + EPSILON)
        return xi, square, total + jnp.where(i >= first, xi, 0.0)

    zero = jnp.zeros_like(xi)
    _, _, total = jax.lax.fori_loop(0, config.steps, step, (xi, zero, zero))
    return total / (config.steps - first)


def align_adam(
    T_prior: Float[Array, "4 4"],
    prior_precision: Float[Array, "dof dof"],
    T_start: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    reference: RGBD,
    observed: RGBD,
    camera: Camera,
    config: AlignConfig,
    key: PRNGKeyArray,
    adam: AdamConfig = AdamConfig(),
    spread: Float[Array, "height width"] | None = None,
) -> tuple[Float[Array, "4 4"], AlignInfo]:
    """``argmin_xi L_geo + L_rgb + 1/2 xi^T P xi``, ``T_ref_cam = T_prior exp(B xi)``, as published (eqs. I6 and I12).

    Args:
        T_prior: Mean of the prior on T_ref_cam.
        prior_precision: P, in the basis' coordinates.
        T_start: Where the search begins; differs from ``T_prior`` by a motion inside the basis.
        basis: B, the twists (translation, rotation; camera frame) the camera may move along.
        reference: RGB-D image at the reference pose.
        observed: RGB-D image at the unknown pose.
        camera: Intrinsics of both.
        config: Which reference depths are edges, and the scales of the final fit quality.
        key: Of the drawn pixels.
        adam: Scales, gates and effort of the search.
        spread: Std of the reference's depth, m, where it is a belief; it widens s_geo.

    Returns:
        T_ref_cam, and its fit quality, computed as for every solver.
    """
    ref, obs = make_reference(reference, camera, config, spread=spread), make_observed(observed, camera)
    ref_rows, obs_rows, usable, count = _rows(ref, obs)
    draws = jax.random.randint(key, (adam.steps, adam.pixels), 0, jnp.maximum(count, 1))
    some = (count > 0).astype(ref_rows.dtype)

    def loss(xi, i):
        rows = obs_rows.at[usable.at[draws[i]].get(mode="promise_in_bounds")].get(mode="promise_in_bounds")
        data = data_loss(T_prior @ se3_exp(basis @ xi), ref_rows, rows, camera, adam)
        return some * data + 0.5 * xi @ prior_precision @ xi

    start = jnp.linalg.pinv(basis) @ se3_log(inverse(T_prior) @ T_start)
    T = T_prior @ se3_exp(basis @ minimise(loss, start, basis, adam))
    sampled = make_observed(observed, camera, every=stride(camera, 1, config))
    return T, fit_quality(T, basis, ref, sampled, camera, config, adam.steps)
