"""Rigid body in space: ``p(z' | z, u)`` of a pose and its velocities (SPEC 1(a), 3 step 1; VSSM-LM, PRISM).

    v' = v + u_lin dt + e_v      t' = t + v dt           e_v ~ N(0, vel_translation^2 dt / 0.1 s), e_w alike
    w' = w + u_ang dt + e_w      R' = exp(w dt) R        and (t', R') is then moved by exp(e), e in the body frame

Velocities and controls are in the world frame. *Velocity first* (PRISM) moves the pose by the new velocity ``v', w'``;
*pose first* (VSSM-LM's Euler step) by the old one. A zero control is the constant-velocity model of hand-held cameras
(SPEC 1(c)). Beliefs are Gaussian in the tangent: ``T_true = T exp(dt, dr)``, ``v_true = v + dv``, ``w_true = w + dw``.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry import inverse, se3_exp, se3_log
from vssm_gym.transition.base import QUOTED_STEP, normal_log_prob, turn_log_volume


class RigidState(eqx.Module):
    """A moving rigid body."""

    T_world_body: Float[Array, "*batch 4 4"]
    velocity: Float[Array, "*batch 6"]  # linear (m/s), angular (rad/s), both in the world frame


class RigidNoise(eqx.Module):
    """Standard deviations of a step of 0.1 s; those of PRISM (SPEC 3). Variances are proportional to ``dt``."""

    vel_translation: Float[Array, ""] | float = 0.03  # m/s
    pose_translation: Float[Array, ""] | float = 0.05  # m
    vel_rotation: Float[Array, ""] | float = 0.03  # rad/s
    pose_rotation: Float[Array, ""] | float = 0.02  # rad

    def variances(self, dt: float | Array) -> tuple[Float[Array, "6"], Float[Array, "6"]]:
        """Of the pose noise (m^2, rad^2; body frame) and of the velocity noise (world frame), after ``dt`` seconds."""
        pose = _pair(self.pose_translation, self.pose_rotation)
        velocity = _pair(self.vel_translation, self.vel_rotation)
        return pose**2 * (dt / QUOTED_STEP), velocity**2 * (dt / QUOTED_STEP)


class RigidBelief(eqx.Module):
    """``N(state, covariance)`` over ``(dt, dr, dv, dw)``: pose error in the body frame, velocity error in the world."""

    state: RigidState
    covariance: Float[Array, "12 12"]

    @property
    def mean(self) -> RigidState:
        """The state the errors are measured from."""
        return self.state


def integrate(
    state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array, *, velocity_first: bool = True
) -> RigidState:
    """The noise-free step.

    Args:
        state: Pose and velocity.
        control: Linear (m/s^2) and angular (rad/s^2) acceleration, world frame; zero for constant velocity.
        dt: Length of the step, s.
        velocity_first: Whether the new velocity moves the pose (PRISM) or the old one (VSSM-LM).

    Returns:
        The state ``dt`` later.
    """
    velocity = state.velocity + control * dt
    return RigidState(move(state.T_world_body, velocity if velocity_first else state.velocity, dt), velocity)


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


def predict(
    belief: RigidBelief,
    control: Float[Array, "6"],
    dt: float | Array,
    noise: RigidNoise,
    *,
    velocity_first: bool = True,
) -> RigidBelief:
    """``int p(z' | z, u) N(z) dz``, linearised at the mean: the Gaussian after one step (SPEC 3, step 1).

    With ``R' = exp(w dt) R`` and the right Jacobian ``Jr``, errors move to first order as
    ``dt' = R'^T (R dt + h dv)``, ``dr' = dr + R^T Jr(w h) h dw`` (``h`` the step), ``dv`` and ``dw`` being the new
    velocity's errors where it moves the pose.
    """
    after = integrate(belief.state, control, dt, velocity_first=velocity_first)
    moving = after.velocity if velocity_first else belief.state.velocity
    by_pose, by_velocity = pose_jacobians(belief.state.T_world_body, moving, dt)
    zero, one = jnp.zeros((6, 6)), jnp.eye(6)
    F = jnp.block([[by_pose, by_velocity], [zero, one]])
    pose_variance, velocity_variance = noise.variances(dt)
    # A new velocity carries its noise into the pose
    G = jnp.concatenate([by_velocity if velocity_first else zero, one])
    covariance = F @ belief.covariance @ F.T + (G * velocity_variance) @ G.T
    covariance = covariance.at[:6, :6].add(jnp.diag(pose_variance))
    return RigidBelief(after, 0.5 * (covariance + covariance.T))


def pose_jacobians(
    T_world_body: Float[Array, "4 4"], velocity: Float[Array, "6"], dt: float | Array
) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """``d(dt', dr') / d(dt, dr)`` and ``d(dt', dr') / d(dv, dw)`` of :func:`move`, at zero error."""
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


def perturb(state: RigidState, xi: Float[Array, "*batch 12"]) -> RigidState:
    """``T exp(dt, dr)``, ``velocity + (dv, dw)``."""
    return RigidState(state.T_world_body @ se3_exp(xi[..., :6]), state.velocity + xi[..., 6:])


def error(mean: RigidState, state: RigidState) -> Float[Array, "*batch 12"]:
    """``(dt, dr, dv, dw)`` with ``perturb(mean, xi) = state``."""
    delta = se3_log(inverse(mean.T_world_body) @ state.T_world_body)
    dv = jnp.broadcast_to(state.velocity - mean.velocity, (*delta.shape[:-1], 6))
    return jnp.concatenate([delta, dv], axis=-1)


def log_volume(xi: Float[Array, "*batch 12"]) -> Float[Array, "*batch"]:
    """``log |det Jr|`` of SE(3) at the pose error; velocities are a vector space."""
    return 2.0 * turn_log_volume(jnp.sum(xi[..., 3:6] ** 2, axis=-1))


class Rigid(eqx.Module):
    """The rigid body as a :class:`~vssm_gym.transition.base.Transition`; controls (..., 6) as of :func:`integrate`."""

    noise: RigidNoise = RigidNoise()
    dt: Float[Array, ""] | float = QUOTED_STEP  # s
    velocity_first: bool = eqx.field(static=True, default=True)

    def sample(self, key: PRNGKeyArray, state: RigidState, control: Float[Array, "*batch 6"]) -> RigidState:
        """``z' ~ p(z' | z, u)``: the velocity and its noise, the motion, the pose noise."""
        pose_variance, velocity_variance = self.noise.variances(self.dt)
        e = jax.random.normal(key, (2, *state.velocity.shape))
        velocity = state.velocity + control * self.dt + e[0] * jnp.sqrt(velocity_variance)
        T = move(state.T_world_body, velocity if self.velocity_first else state.velocity, self.dt)
        return RigidState(T @ se3_exp(e[1] * jnp.sqrt(pose_variance)), velocity)

    def log_prob(
        self, following: RigidState, state: RigidState, control: Float[Array, "*batch 6"]
    ) -> Float[Array, "*batch"]:
        """``log p(vel' | vel, u) + log p(pose' | pose, vel or vel')``."""
        pose_variance, velocity_variance = self.noise.variances(self.dt)
        velocity = following.velocity if self.velocity_first else state.velocity
        mean = RigidState(move(state.T_world_body, velocity, self.dt), state.velocity + control * self.dt)
        xi = error(mean, following)
        variances = jnp.concatenate([pose_variance, velocity_variance])
        return normal_log_prob(xi, jnp.diag(variances)) - log_volume(xi)

    def pose(self, state: RigidState) -> Float[Array, "*batch 4 4"]:
        """``T_world_body``."""
        return state.T_world_body

    perturb = staticmethod(perturb)
    error = staticmethod(error)
    log_volume = staticmethod(log_volume)


def _pair(translation: float | Array, rotation: float | Array) -> Array:
    return jnp.concatenate([jnp.full(3, translation), jnp.full(3, rotation)])
