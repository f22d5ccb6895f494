"""``argmin_R sum rho(I_last[pi(R p)] - I[pi(p)])``: the rotation between two images, p on the plane at depth 1.

A rotation moves pixels by a homography that does not depend on depth. Estimated on small images, coarse to fine, it
initialises the alignment of hand-held images: a hand turns a camera faster than a constant-velocity model predicts.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.residuals import shrink_camera, shrink_image


@dataclass(frozen=True)
class RotationConfig:
    """Configure image sizes, gates and effort."""

    widths: tuple[int, ...] = (20, 40, 80)  # of the images, coarse to fine; the coarsest has the widest basin
    iterations: int = 8  # at most, per width
    tolerance: float = 2e-4  # rad: a smaller step ends the width; a twentieth of a pixel of the finest image
    sigma: float = 0.04  # luminance
    huber: float = 1.345
    gate: float = 0.30  # luminance; pairs that differ more show different surfaces


def _derivatives(grey: Array) -> tuple[Array, Array, Array]:
    """Return horizontal and vertical central differences, and where both exist."""
    du = 0.5 * (jnp.roll(grey, -1, 1) - jnp.roll(grey, 1, 1))
    dv = 0.5 * (jnp.roll(grey, -1, 0) - jnp.roll(grey, 1, 0))
    inner = jnp.zeros(grey.shape, bool).at[1:-1, 1:-1].set(True)
    return du, dv, inner


def _turn(R: Array, last: Array, grey: Array, view: Camera, config: RotationConfig) -> Array:
    """Estimate the rotation by Gauss-Newton on one image size, from ``R`` = R_last_cam."""
    du, dv, inner = _derivatives(last)
    reference = jnp.stack([last, du, dv, inner.astype(last.dtype)]).reshape(4, -1)
    rays = jnp.moveaxis(view.rays(), -1, 0).reshape(3, -1)
    value = grey.reshape(-1)

    def step(carry):
        R, _, count = carry
        q = R @ rays
        ahead = q[2] > 0.1
        inverse_z = 1.0 / jnp.where(ahead, q[2], 1.0)
        x, y = q[0] * inverse_z, q[1] * inverse_z
        u, v = x * view.fx + view.cx, y * view.fy + view.cy
        i, j = jnp.round(u), jnp.round(v)
        inside = ahead & (i >= 0) & (i < view.width) & (j >= 0) & (j < view.height)
        pixel = jnp.where(inside, j * view.width + i, 0.0).astype(jnp.int32)
        seen = reference.at[:, pixel].get(mode="promise_in_bounds")
        r = seen[0] + seen[1] * (u - i) + seen[2] * (v - j) - value
        use = inside & (seen[3] > 0.5) & (jnp.abs(r) < config.gate)
        weight = use * jnp.minimum(1.0, config.huber * config.sigma / jnp.maximum(jnp.abs(r), 1e-6))
        gx, gy = seen[1] * view.fx, seen[2] * view.fy
        # exp(w) R moves the unit-depth point (x, y, 1) by w x (x, y, 1); its projection moves by the rows below.
        J = jnp.stack([-gx * x * y - gy * (1.0 + y * y), gx * (1.0 + x * x) + gy * x * y, gy * x - gx * y])
        wJ = J * weight
        H = wJ @ J.T
        delta = -jnp.linalg.solve(H + (1e-6 + 1e-4 * jnp.trace(H)) * jnp.eye(3), wJ @ r)
        # A step of more than a quarter of the view is no refinement: the image has too little texture.
        delta = jnp.clip(delta, -0.15, 0.15)
        return jaxlie.SO3.exp(delta).as_matrix() @ R, jnp.max(jnp.abs(delta)), count + 1

    def unfinished(carry):
        return (carry[2] < config.iterations) & (carry[1] > config.tolerance)

    return jax.lax.while_loop(unfinished, step, (R, jnp.asarray(jnp.inf, R.dtype), 0))[0]


def camera_rotation(
    grey: Float[Array, "height width"],
    last: Float[Array, "height width"],
    camera: Camera,
    config: RotationConfig = RotationConfig(),
    start: Float[Array, "3 3"] | None = None,
) -> Float[Array, "3 3"]:
    """Estimate R_last_cam of a pure rotation (eq. I14).

    Args:
        grey: Luminance of the image, [0, 1].
        last: Luminance of the image before.
        camera: Intrinsics of both.
        config: Sizes, gates and effort.
        start: R_last_cam where the search begins; None: no rotation.
    """
    R = jnp.eye(3) if start is None else start
    for factor in dict.fromkeys(max(1, camera.width // width) for width in config.widths):
        R = _turn(R, shrink_image(last, factor), shrink_image(grey, factor), shrink_camera(camera, factor), config)
    return R
