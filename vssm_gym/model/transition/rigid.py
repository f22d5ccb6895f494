"""Model a rigid body in space: ``p(z' | z, u)`` of a pose and its velocities (VSSM-LM, PRISM).

    v' = v + u_lin dt + e_v      t' = t + v dt           e_v ~ N(0, vel_translation^2 dt / 0.1 s), e_w alike
    w' = w + u_ang dt + e_w      R' = exp(w dt) R        and (t', R') is then moved by exp(e), e in the body frame

Velocities and controls are in the world frame. *Velocity first* (PRISM) moves the pose by the new velocity ``v', w'``;
*pose first* (VSSM-LM's Euler step) by the old one. A zero control is the constant-velocity model of hand-held cameras.
Beliefs are Gaussian in the tangent: ``T_true = T exp(dt, dr)``, ``v_true = v + dv``, ``w_true = w + dw``.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.model.transition.base import QUOTED_STEP, Transition
from vssm_gym.model.transition.belief import GaussianBelief, normal_log_prob
from vssm_gym.model.transition.manifold import RIGID, RigidState


class RigidNoise(eqx.Module):
    """Hold standard deviations of a step of 0.1 s, PRISM's by default; variances are proportional to ``dt``.

    Attributes:
        vel_translation: of the linear velocity, m/s.
        pose_translation: of the position, m.
        vel_rotation: of the angular velocity, rad/s.
        pose_rotation: of the orientation, rad.
    """

    vel_translation: Float[Array, ""] | float = 0.03
    pose_translation: Float[Array, ""] | float = 0.05
    vel_rotation: Float[Array, ""] | float = 0.03
    pose_rotation: Float[Array, ""] | float = 0.02

    def variances(self, dt: float | Array) -> tuple[Float[Array, "6"], Float[Array, "6"]]:
        """Return the variances that a step adds.

        Args:
            dt: length of the step, s.

        Returns:
            Of the pose (m^2, rad^2; body frame) and of the velocity ((m/s)^2, (rad/s)^2; world frame).
        """
        pose = _pair(self.pose_translation, self.pose_rotation)
        velocity = _pair(self.vel_translation, self.vel_rotation)
        return pose**2 * (dt / QUOTED_STEP), velocity**2 * (dt / QUOTED_STEP)


def move(
    T_world_body: Float[Array, "*batch 4 4"], velocity: Float[Array, "*batch 6"], dt: float | Array
) -> Float[Array, "*batch 4 4"]:
    """``t' = t + v dt``, ``R' = exp(w dt) R``: a pose moved by world-frame velocities for ``dt`` seconds."""
    R = jaxlie.SO3.exp(velocity[..., 3:] * dt).as_matrix() @ T_world_body[..., :3, :3]
    t = T_world_body[..., :3, 3] + velocity[..., :3] * dt
    return T_world_body.at[..., :3, :].set(jnp.concatenate([nearest_rotation(R), t[..., None]], axis=-1))


def nearest_rotation(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """``R (3 - R^T R) / 2``: one Newton step to ``R^T R = 1``, from which float32 products drift over many steps."""
    return 1.5 * R - 0.5 * R @ (jnp.swapaxes(R, -1, -2) @ R)


def pose_jacobians(
    T_world_body: Float[Array, "4 4"], velocity: Float[Array, "6"], dt: float | Array
) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """``d(dt', dr') / d(dt, dr)`` and ``d(dt', dr') / d(dv, dw)`` of :func:`move`, at zero error (eq. M21)."""
    R = T_world_body[:3, :3]
    turn = velocity[3:] * dt
    R_after = jaxlie.SO3.exp(turn).as_matrix() @ R
    zero = jnp.zeros((3, 3))
    by_pose = jnp.block([[R_after.T @ R, zero], [zero, jnp.eye(3)]])
    by_velocity = jnp.block([[R_after.T * dt, zero], [zero, R.T @ right_jacobian(turn) * dt]])
    return by_pose, by_velocity


def right_jacobian(phi: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """``Jr`` of SO(3): ``exp(phi + d) = exp(phi) exp(Jr(phi) d)`` to first order."""
    # The columns of V(-phi), the translation part of the exponential of SE(3)
    return se3_exp(jnp.concatenate([jnp.eye(3), jnp.broadcast_to(-phi, (3, 3))], axis=1))[:, :3, 3].T


class Rigid(Transition):
    """Model a rigid body in space; a control of zero is constant velocity, the model of a hand-held camera.

    States hold ``T_world_body`` ``(4, 4)`` and ``velocity`` ``(6,)``: linear (m/s) and angular (rad/s), world frame.
    Controls are linear (m/s^2) and angular (rad/s^2) acceleration, world frame.

    Attributes:
        noise: of velocity and pose.
        velocity_first: whether the new velocity moves the pose (PRISM), or the old one (VSSM-LM).
    """

    noise: RigidNoise = RigidNoise()
    velocity_first: bool = eqx.field(static=True, default=True)

    manifold = RIGID
    controls = 6
    commanded = False

    def mean(self, state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array) -> RigidState:
        """Integrate velocity and pose; a zero control keeps the velocity (eq. M21)."""
        velocity = state.velocity + control * dt
        return RigidState(move(state.T_world_body, velocity if self.velocity_first else state.velocity, dt), velocity)

    def jacobian(self, state: RigidState, control: Float[Array, "6"], dt: float | Array) -> Float[Array, "12 12"]:
        """``dt' = R'^T (R dt + h dv)``, ``dr' = dr + R^T Jr(w h) h dw``, ``h`` the step.

        ``R' = exp(w h) R``, ``Jr`` the right Jacobian; ``dv`` and ``dw`` are the new velocity's errors where it moves
        the pose.
        """
        by_pose, by_velocity = pose_jacobians(state.T_world_body, self._moving(state, control, dt), dt)
        return jnp.block([[by_pose, by_velocity], [jnp.zeros((6, 6)), jnp.eye(6)]])

    def noise_covariance(
        self, state: RigidState, control: Float[Array, "6"], dt: float | Array
    ) -> Float[Array, "12 12"]:
        """``G V G^T + diag(pose noise)``: a new velocity carries its noise into the pose."""
        pose_variance, velocity_variance = self.noise.variances(dt)
        by_velocity = jnp.zeros((6, 6))
        if self.velocity_first:
            _, by_velocity = pose_jacobians(state.T_world_body, self._moving(state, control, dt), dt)
        G = jnp.concatenate([by_velocity, jnp.eye(6)])
        return ((G * velocity_variance) @ G.T).at[:6, :6].add(jnp.diag(pose_variance))

    def sample(
        self, key: PRNGKeyArray, state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array
    ) -> RigidState:
        """Draw the velocity and its noise, the motion, the pose noise."""
        pose_variance, velocity_variance = self.noise.variances(dt)
        e = jax.random.normal(key, (2, *state.velocity.shape))
        velocity = state.velocity + control * dt + e[0] * jnp.sqrt(velocity_variance)
        T = move(state.T_world_body, velocity if self.velocity_first else state.velocity, dt)
        return RigidState(T @ se3_exp(e[1] * jnp.sqrt(pose_variance)), velocity)

    def log_prob(
        self, following: RigidState, state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array
    ) -> Float[Array, "*batch"]:
        """``log p(vel' | vel, u) + log p(pose' | pose, vel or vel')``: exact, where the default is of first order."""
        pose_variance, velocity_variance = self.noise.variances(dt)
        velocity = following.velocity if self.velocity_first else state.velocity
        mean = RigidState(move(state.T_world_body, velocity, dt), state.velocity + control * dt)
        xi = RIGID.error(mean, following)
        variances = jnp.concatenate([pose_variance, velocity_variance])
        return normal_log_prob(xi, jnp.diag(variances)) - RIGID.log_volume(xi)

    def _moving(self, state: RigidState, control: Float[Array, "6"], dt: float | Array) -> Float[Array, "6"]:
        """Return the velocity that moves the pose."""
        return state.velocity + control * dt if self.velocity_first else state.velocity


def rigid_belief(state: RigidState, covariance: Float[Array, "12 12"]) -> GaussianBelief:
    """``N(state, covariance)`` over ``(dt, dr, dv, dw)``: pose error in the body frame, velocity error in the world."""
    return GaussianBelief(state, covariance, RIGID)


def _pair(translation: float | Array, rotation: float | Array) -> Array:
    return jnp.concatenate([jnp.full(3, translation), jnp.full(3, rotation)])
