"""Describe a state in the axes of its body, where neither place nor yaw is visible.

A network that reads only these features, and whose output is an error in body axes, commutes with translations and with
turns about the vertical: no augmentation by random places and headings is needed to teach it that.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.model.transition.manifold import PLANAR, RIGID, Manifold, RigidState


@runtime_checkable
class BodyAxes(Protocol):
    """Describe the states of one manifold in body axes."""

    @property
    def features(self) -> int:
        """Return the number of features."""

    def describe(self, state: Any) -> Array:
        """Return what the body senses of its state, without place and yaw: (..., features)."""

    def to_errors(self, state: Any, xi: Array) -> Array:
        """Rotate ``xi`` (..., n), all in body axes, to an error of the manifold at ``state``."""

    def from_errors(self, state: Any, xi: Array) -> Array:
        """Rotate an error of the manifold at ``state`` to body axes: the inverse of :meth:`to_errors`."""


@dataclass(frozen=True)
class RigidAxes:
    """Describe a rigid body by ``(R^T v, R^T w, R^T e_z)``: m/s, rad/s, and the vertical as the body sees it."""

    features: int = 9

    def describe(self, state: RigidState) -> Float[Array, "*batch 9"]:
        """``(R^T v, R^T w, R^T e_z)``."""
        R = state.T_world_body[..., :3, :3]
        velocity = _back(R, state.velocity)
        return jnp.concatenate([velocity, R[..., 2, :]], axis=-1)

    def to_errors(self, state: RigidState, xi: Float[Array, "*batch 12"]) -> Float[Array, "*batch 12"]:
        """``(dt, dr, R dv, R dw)``: the errors of poses are in the body frame, those of velocities in the world's."""
        R = jnp.swapaxes(state.T_world_body[..., :3, :3], -1, -2)
        return jnp.concatenate([xi[..., :6], _back(R, xi[..., 6:])], axis=-1)

    def from_errors(self, state: RigidState, xi: Float[Array, "*batch 12"]) -> Float[Array, "*batch 12"]:
        """``(dt, dr, R^T dv, R^T dw)``."""
        return jnp.concatenate([xi[..., :6], _back(state.T_world_body[..., :3, :3], xi[..., 6:])], axis=-1)


@dataclass(frozen=True)
class PlanarAxes:
    """Describe a robot on the floor: without place and heading, nothing of ``(x, y, heading)`` is left."""

    features: int = 0

    def describe(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch 0"]:
        """Return no feature."""
        return state[..., :0]

    def to_errors(self, state: Float[Array, "*batch 3"], xi: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Return ``xi``: errors (forward, left, turn) are in the body frame already."""
        return xi

    def from_errors(self, state: Float[Array, "*batch 3"], xi: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Return ``xi``."""
        return xi


def body_axes(manifold: Manifold) -> BodyAxes:
    """Return the description of the states of a manifold, PLANAR or RIGID.

    Raises:
        KeyError: another manifold, of which no description in body axes is known.
    """
    return _AXES[manifold]


_AXES: dict[Manifold, BodyAxes] = {RIGID: RigidAxes(), PLANAR: PlanarAxes()}


def _back(R: Array, vectors: Array) -> Array:
    """``R^T`` applied to each of two vectors (..., 6)."""
    turned = jnp.einsum("...ji,...kj->...ki", R, vectors.reshape(*vectors.shape[:-1], 2, 3))
    return turned.reshape(*turned.shape[:-2], 6)
