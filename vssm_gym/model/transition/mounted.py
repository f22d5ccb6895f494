"""See a learned transition of a body from its camera, in a world that need not be level (SLAM's is its first camera).

    z_cam' = to_camera(f(to_body(z_cam), u)),    T_level_body = T_level_world T_world_cam T_body_cam^-1

The learned step knows a body in a world whose z axis points up; a filter that is given only images knows a camera in
the frame of its first image. Velocities are those of the camera, in that frame's axes: ``v_cam = v_body + w x r``.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import inverse
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.manifold import RigidState
from vssm_gym.model.transition.with_rest import RestState, WithRest


class Mounted(Transition):
    """Move a camera by the learned transition of the rigid body that carries it.

    Attributes:
        learned: of the body, in a level world.
        T_level_world: ``(4, 4)`` pose of the filter's world in a level one.
        T_body_cam: ``(4, 4)`` pose of the camera on the body, m.
    """

    learned: LearnedTransition
    T_level_world: Float[Array, "4 4"]
    T_body_cam: Float[Array, "4 4"]

    commanded = False

    @property
    def manifold(self) -> WithRest:  # type: ignore[override]
        """Return that of the learned transition: here of the camera's states."""
        return self.learned.manifold

    @property
    def controls(self) -> int:  # type: ignore[override]
        """Return those of the learned transition."""
        return self.learned.controls

    def mean(self, state: RestState, control: Float[Array, "*batch m"], dt: float | Array) -> RestState:
        """Take the step of the body."""
        return self.to_camera(self.learned.mean(self.to_body(state), control, dt))

    def noise_covariance(self, state: RestState, control: Float[Array, "m"], dt: float | Array) -> Float[Array, "n n"]:
        """``J Q J^T``, J from errors of the body to those of the camera."""
        before = self.to_body(state)
        after, manifold = self.learned.mean(before, control, dt), self.manifold
        camera = self.to_camera(after)
        moved = lambda xi: manifold.error(camera, self.to_camera(manifold.perturb(after, xi)))
        J = jax.jacfwd(moved)(jnp.zeros(len(manifold.turns)))
        return J @ self.learned.noise_covariance(before, control, dt) @ J.T

    def to_body(self, state: RestState) -> RestState:
        """Return the body's state in the level world, of the camera's in the filter's."""
        at = RigidState(state.body.T_world_body, state.body.velocity)
        T = self.T_level_world @ at.T_world_body @ inverse(self.T_body_cam)
        R = self.T_level_world[:3, :3]
        v, w = (jnp.einsum("ij,...j->...i", R, at.velocity[..., k : k + 3]) for k in (0, 3))
        return RestState(RigidState(T, jnp.concatenate([v - jnp.cross(w, self._arm(T)), w], axis=-1)), state.rest)

    def to_camera(self, state: RestState) -> RestState:
        """Return the camera's state in the filter's world: the inverse of :meth:`to_body`."""
        T, R = state.body.T_world_body, self.T_level_world[:3, :3]
        v, w = state.body.velocity[..., :3], state.body.velocity[..., 3:]
        v = v + jnp.cross(w, self._arm(T))
        velocity = jnp.concatenate([jnp.einsum("ji,...j->...i", R, a) for a in (v, w)], axis=-1)
        return RestState(RigidState(inverse(self.T_level_world) @ T @ self.T_body_cam, velocity), state.rest)

    def extend(self, of_camera: GaussianBelief) -> GaussianBelief:
        """Return a belief over camera and rest of one over the camera: the rest is at its prior ``N(0, 1)``."""
        return self.learned.extend(of_camera)

    def _arm(self, T_level_body: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 3"]:
        """Return the way from the body's origin to the camera, m, in level axes."""
        return jnp.einsum("...ij,j->...i", T_level_body[..., :3, :3], self.T_body_cam[:3, 3])
