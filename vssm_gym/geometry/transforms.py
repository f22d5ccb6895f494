"""Compute rigid motions: SE(3) as 4x4 matrices, SE(2) as ``(x, y, heading)``.

Frames cancel in names: ``p_world = T_world_cam @ p_cam``. The functions serve NumPy (float64, the simulator) and JAX
(float32, the model) alike: they compute in the namespace of their argument.
"""

import math
from typing import Any

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

# Columns: the camera's axes in the body frame; z looks along body x, x to body -y, y down.
R_BODY_CAM = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))


def wrap_angle(angle: Any) -> Any:
    """Return ``angle`` modulo 2 pi, in [-pi, pi); rad, any shape."""
    if isinstance(angle, float):
        return (angle + math.pi) % (2 * math.pi) - math.pi
    xp = angle.__array_namespace__() if hasattr(angle, "__array_namespace__") else jnp
    return xp.remainder(angle + xp.pi, 2 * xp.pi) - xp.pi


def transform(T_a_b: Any, p_b: Any) -> Any:
    """``p_a = R p_b + t``.

    Args:
        T_a_b: ``(..., 4, 4)`` rigid motion, metres.
        p_b: ``(..., 3)`` points in frame b.

    Returns:
        ``(..., 3)`` points in frame a.
    """
    xp = p_b.__array_namespace__()
    return xp.einsum("...ij,...j->...i", T_a_b[..., :3, :3], p_b) + T_a_b[..., :3, 3]


def inverse(T_a_b: Any) -> Any:
    """``T_b_a = [R^T, -R^T t]``: the exact inverse of rigid ``(..., 4, 4)`` matrices."""
    xp = T_a_b.__array_namespace__()
    R_b_a = xp.swapaxes(T_a_b[..., :3, :3], -1, -2)
    t_b_a = -xp.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3])
    top = xp.concatenate([R_b_a, t_b_a[..., None]], axis=-1)
    bottom = xp.broadcast_to(xp.asarray([0.0, 0.0, 0.0, 1.0], dtype=top.dtype), (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, bottom], axis=-2)


def planar_to_matrix(planar: Any) -> Any:
    """Convert planar poses ``(x, y, heading)`` ``(..., 3)`` to ``T_world_body`` ``(..., 4, 4)`` at height 0."""
    xp = planar.__array_namespace__()
    x, y, heading = planar[..., 0], planar[..., 1], planar[..., 2]
    c, s = xp.cos(heading), xp.sin(heading)
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    rows = [c, -s, zero, x, s, c, zero, y, zero, zero, one, zero, zero, zero, zero, one]
    return xp.stack(rows, axis=-1).reshape(*planar.shape[:-1], 4, 4)


def matrix_to_planar(T_world_body: Any) -> Any:
    """Return ``(x, y, heading)`` of ``(..., 4, 4)`` poses: position on the floor and yaw of the body's x axis."""
    xp = T_world_body.__array_namespace__()
    heading = xp.arctan2(T_world_body[..., 1, 0], T_world_body[..., 0, 0])
    return xp.stack([T_world_body[..., 0, 3], T_world_body[..., 1, 3], heading], axis=-1)


def se3_exp(delta: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
    """``exp(delta^)``: the rigid motion of a tangent (translation, rotation); beliefs are ``T exp(delta)``."""
    v, w = delta[..., :3], delta[..., 3:]
    # t = V v, V = 1 + a w^ + b w^ w^. jaxlie's own takes V = R below 3 mrad, which is wrong in its first order.
    theta2 = jnp.sum(w * w, axis=-1, keepdims=True)
    near = theta2 < 0.1
    safe2 = jnp.where(near, 1.0, theta2)
    theta = jnp.sqrt(safe2)
    a = jnp.where(near, 1 / 2 - theta2 * (1 / 24 - theta2 * (1 / 720 - theta2 / 40320)), (1 - jnp.cos(theta)) / safe2)
    series = 1 / 6 - theta2 * (1 / 120 - theta2 * (1 / 5040 - theta2 / 362880))
    b = jnp.where(near, series, (theta - jnp.sin(theta)) / (theta * safe2))
    w_v = jnp.cross(w, v)
    t = v + a * w_v + b * jnp.cross(w, w_v)
    top = jnp.concatenate([jaxlie.SO3.exp(w).as_matrix(), t[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0], top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def se3_log(T: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 6"]:
    """``log(T)``: the tangent (translation, rotation) of a rigid motion, the inverse of :func:`se3_exp` (eq. M15)."""
    return jaxlie.SE3.from_matrix(T).log()


def se3_adjoint(T: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 6 6"]:
    """``T exp(delta) T^-1 = exp(Ad_T delta)``: the adjoint, which transforms covariances between frames (eq. M17)."""
    return jaxlie.SE3.from_matrix(T).adjoint()
