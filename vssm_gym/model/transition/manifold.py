"""Define state spaces: poses with their tangents, in whose coordinates beliefs are Gaussian.

    z = perturb(mean, xi),    xi = error(mean, z),    T_world_body of z' = T_world_body of z exp(twists xi_pose)

An error ``xi`` lists the pose's coordinates first (translation before rotation, in the body frame), then the rest of
the state. A density on a group is taken with respect to its own volume: metres along each axis times the angle turned.
Where ``T = T_mean exp(xi)`` and ``xi`` is Gaussian, that is ``p(T) = N(xi) / |det Jr(xi)|``, ``Jr`` the right Jacobian.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import inverse, matrix_to_planar, planar_to_matrix, se3_exp, se3_log


@runtime_checkable
class Manifold(Protocol):
    """Describe a space of states.

    Implementations are frozen and without fields, so that they are static in compiled code.
    """

    @property
    def twists(self) -> np.ndarray:
        """Return ``(6, p)`` body twists (translation, rotation) of the pose's ``p`` coordinates, which come first."""

    @property
    def turns(self) -> np.ndarray:
        """Return which coordinates of an error are angles or angular rates, ``(n,)`` bool."""

    def perturb(self, state: Any, xi: Array) -> Any:
        """Return the state an error ``xi`` (..., n) away from ``state``."""

    def error(self, mean: Any, state: Any) -> Array:
        """Return ``xi`` (..., n) with ``perturb(mean, xi) = state``."""

    def log_volume(self, xi: Array) -> Array:
        """Return ``log |det d perturb / d xi|``: volume of state space per volume of errors."""

    def pose(self, state: Any) -> Array:
        """Return ``T_world_body`` (..., 4, 4) of a state."""

    def resting(self, T_world_body: Array) -> Any:
        """Return the state of a body at a pose (4, 4) that does not move."""


class RigidState(eqx.Module):
    """Represent the state of a moving rigid body."""

    T_world_body: Float[Array, "*batch 4 4"]
    velocity: Float[Array, "*batch 6"]  # linear (m/s), angular (rad/s), both in the world frame


@dataclass(frozen=True)
class PlanarPoses:
    """Describe SE(2): states ``(x, y, heading)`` (..., 3), m, rad; errors (forward, left, turn) in the body frame."""

    twists: ClassVar[np.ndarray] = np.eye(6)[:, [0, 1, 5]]
    turns: ClassVar[np.ndarray] = np.array([False, False, True])

    def perturb(self, planar: Float[Array, "*mean 3"], xi: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """``T exp(xi)``."""
        zero = jnp.zeros_like(xi[..., 0])
        twist = jnp.stack([xi[..., 0], xi[..., 1], zero, zero, zero, xi[..., 2]], axis=-1)
        return matrix_to_planar(planar_to_matrix(planar) @ se3_exp(twist))

    def error(self, mean: Float[Array, "*mean 3"], planar: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """``xi = log(T_mean^-1 T)``."""
        twist = se3_log(inverse(planar_to_matrix(mean)) @ planar_to_matrix(planar))
        return jnp.stack([twist[..., 0], twist[..., 1], twist[..., 5]], axis=-1)

    def log_volume(self, xi: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """``log |det Jr|`` of SE(2; eq. M16)."""
        return _turn_log_volume(xi[..., 2] ** 2)

    def pose(self, planar: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4 4"]:
        """Return ``T_world_body`` on the floor."""
        return planar_to_matrix(planar)

    def resting(self, T_world_body: Float[Array, "4 4"]) -> Float[Array, "3"]:
        """Return ``(x, y, heading)`` of a pose on the floor."""
        return matrix_to_planar(T_world_body)


@dataclass(frozen=True)
class RigidMotions:
    """Describe SE(3) x R^6: :class:`RigidState`; errors ``(dt, dr, dv, dw)``, the pose's in the body frame.

    ``T_true = T exp(dt, dr)``, ``v_true = v + dv``, ``w_true = w + dw``; velocities in the world frame.
    """

    twists: ClassVar[np.ndarray] = np.eye(6)
    turns: ClassVar[np.ndarray] = np.array(2 * [False, False, False, True, True, True])

    def perturb(self, state: RigidState, xi: Float[Array, "*batch 12"]) -> RigidState:
        """``T exp(dt, dr)``, ``velocity + (dv, dw)``."""
        return RigidState(state.T_world_body @ se3_exp(xi[..., :6]), state.velocity + xi[..., 6:])

    def error(self, mean: RigidState, state: RigidState) -> Float[Array, "*batch 12"]:
        """``(log(T_mean^-1 T), velocity - velocity_mean)``."""
        delta = se3_log(inverse(mean.T_world_body) @ state.T_world_body)
        dv = jnp.broadcast_to(state.velocity - mean.velocity, (*delta.shape[:-1], 6))
        return jnp.concatenate([delta, dv], axis=-1)

    def log_volume(self, xi: Float[Array, "*batch 12"]) -> Float[Array, "*batch"]:
        """``log |det Jr|`` of SE(3) at the pose error; velocities are a vector space (eq. M16)."""
        return 2.0 * _turn_log_volume(jnp.sum(xi[..., 3:6] ** 2, axis=-1))

    def pose(self, state: RigidState) -> Float[Array, "*batch 4 4"]:
        """Return ``T_world_body``."""
        return state.T_world_body

    def resting(self, T_world_body: Float[Array, "4 4"]) -> RigidState:
        """Return the pose with velocity zero."""
        return RigidState(T_world_body, jnp.zeros(6))


@dataclass(frozen=True)
class RigidPoses:
    """Describe SE(3): states ``T_world_body`` (..., 4, 4); errors ``(dt, dr)`` (m, rad) in the body frame.

    The pose of a :class:`RigidMotions` without its velocities, such as that of one image.
    """

    twists: ClassVar[np.ndarray] = np.eye(6)
    turns: ClassVar[np.ndarray] = np.array([False, False, False, True, True, True])

    def perturb(self, T_world_body: Float[Array, "*mean 4 4"], xi: Float[Array, "*batch 6"]) -> Array:
        """``T exp(dt, dr)``."""
        return T_world_body @ se3_exp(xi)

    def error(self, mean: Float[Array, "*mean 4 4"], T_world_body: Float[Array, "*batch 4 4"]) -> Array:
        """``log(T_mean^-1 T)``."""
        return se3_log(inverse(mean) @ T_world_body)

    def log_volume(self, xi: Float[Array, "*batch 6"]) -> Float[Array, "*batch"]:
        """``log |det Jr|`` of SE(3; eq. M16)."""
        return 2.0 * _turn_log_volume(jnp.sum(xi[..., 3:] ** 2, axis=-1))

    def pose(self, T_world_body: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
        """Return the state itself."""
        return T_world_body

    def resting(self, T_world_body: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        """Return the pose."""
        return T_world_body


PLANAR, RIGID, POSES = PlanarPoses(), RigidMotions(), RigidPoses()


def _turn_log_volume(angle2: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """``log(2 (1 - cos a) / a^2)`` of the squared angle: ``log |det Jr|`` of SO(3) and of SE(2), half that of SE(3)."""
    near = angle2 < 1e-2
    safe2 = jnp.where(near, 1.0, angle2)
    far = jnp.log(jnp.maximum(2.0 * (1.0 - jnp.cos(jnp.sqrt(safe2))) / safe2, 1e-12))
    return jnp.where(near, -angle2 / 12.0 - angle2**2 / 1440.0, far)
