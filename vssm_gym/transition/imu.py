"""A body that carries an IMU: ``p(z' | z, u)`` driven by its gyroscope and accelerometer (SPEC 1(b); VSSM-LM).

    v' = v + (R a + g) dt      t' = t + (v + v') dt / 2      R' = R exp(w_b dt)      w' = R' w_b

``u = (a, w_b)``: specific force and rate in the body frame, biases removed; ``g = (0, 0, -9.81)`` in the world.
Velocities in the state are in the world frame, as of :mod:`vssm_gym.transition.rigid`, whose states and beliefs these
are. The pose takes the mean of the two velocities, so a constant acceleration is integrated exactly at 10 Hz too.
Gaussian noise is added to the new velocity, and moves the new pose by ``exp(e)``, e in the body frame.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.transition import rigid
from vssm_gym.transition.base import QUOTED_STEP, normal_log_prob
from vssm_gym.transition.rigid import RigidBelief, RigidState

GRAVITY = (0.0, 0.0, -9.81)  # m/s^2, world


class ImuNoise(eqx.Module):
    """Standard deviations of a step of 0.1 s (SPEC 1(b)); variances are proportional to ``dt``."""

    location: Float[Array, ""] | float = 0.01  # m
    orientation: Float[Array, ""] | float = 0.001  # rad
    velocity: Float[Array, ""] | float = 0.001  # m/s
    rate: Float[Array, ""] | float = 0.001  # rad/s, of the angular velocity read from the gyroscope

    def variances(self, dt: float | Array) -> Float[Array, "12"]:
        """Of ``(dt, dr, dv, dw)`` after ``dt`` seconds."""
        stds = [jnp.full(3, std) for std in (self.location, self.orientation, self.velocity, self.rate)]
        return jnp.concatenate(stds) ** 2 * (dt / QUOTED_STEP)


def integrate(state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array) -> RigidState:
    """The noise-free step.

    Args:
        state: Pose and velocities; the old angular velocity is not used, the gyroscope reads it anew.
        control: Specific force (m/s^2) and angular rate (rad/s), body frame.
        dt: Length of the step, s.

    Returns:
        The state ``dt`` later.
    """
    R, t = state.T_world_body[..., :3, :3], state.T_world_body[..., :3, 3]
    v = state.velocity[..., :3]
    v_after = v + (_rotate(R, control[..., :3]) + jnp.asarray(GRAVITY)) * dt
    R_after = R @ jaxlie.SO3.exp(control[..., 3:] * dt).as_matrix()
    R_after = rigid.nearest_rotation(R_after)
    top = jnp.concatenate([R_after, (t + 0.5 * (v + v_after) * dt)[..., None]], axis=-1)
    T = state.T_world_body.at[..., :3, :].set(top)
    return RigidState(T, jnp.concatenate([v_after, _rotate(R_after, control[..., 3:])], axis=-1))


def predict(belief: RigidBelief, control: Float[Array, "6"], dt: float | Array, noise: ImuNoise) -> RigidBelief:
    """``int p(z' | z, u) N(z) dz``, linearised at the mean.

    To first order, with ``h`` the step: ``dr' = exp(-w_b h) dr``, ``dv' = dv - h R a^ dr``,
    ``dt' = R'^T (R dt + h dv - h^2/2 R a^ dr)``, ``dw' = -R' w_b^ dr'``.
    """
    after = integrate(belief.state, control, dt)
    R, R_after = belief.state.T_world_body[:3, :3], after.T_world_body[:3, :3]
    turned_back = R_after.T @ R
    tilt = -R @ _cross_matrix(control[:3]) * dt  # d v' / d dr: a tilted body pushes elsewhere
    spin = -R_after @ _cross_matrix(control[3:]) @ turned_back
    zero, one = jnp.zeros((3, 3)), jnp.eye(3)
    F = jnp.block(
        [
            [turned_back, 0.5 * dt * R_after.T @ tilt, dt * R_after.T, zero],
            [zero, turned_back, zero, zero],
            [zero, tilt, one, zero],
            [zero, spin, zero, zero],
        ]
    )
    covariance = F @ belief.covariance @ F.T + jnp.diag(noise.variances(dt))
    return RigidBelief(after, 0.5 * (covariance + covariance.T))


class Imu(eqx.Module):
    """The IMU-driven body as a :class:`~vssm_gym.transition.base.Transition`; controls (..., 6) = (a, w_b)."""

    noise: ImuNoise = ImuNoise()
    dt: Float[Array, ""] | float = QUOTED_STEP  # s; 10 Hz

    def sample(self, key: PRNGKeyArray, state: RigidState, control: Float[Array, "*batch 6"]) -> RigidState:
        """``z' ~ p(z' | z, u)``."""
        e = jax.random.normal(key, (*state.velocity.shape[:-1], 12)) * jnp.sqrt(self.noise.variances(self.dt))
        return rigid.perturb(integrate(state, control, self.dt), e)

    def log_prob(
        self, following: RigidState, state: RigidState, control: Float[Array, "*batch 6"]
    ) -> Float[Array, "*batch"]:
        """``log p(z' | z, u)``."""
        xi = rigid.error(integrate(state, control, self.dt), following)
        return normal_log_prob(xi, jnp.diag(self.noise.variances(self.dt))) - rigid.log_volume(xi)

    def pose(self, state: RigidState) -> Float[Array, "*batch 4 4"]:
        """``T_world_body``."""
        return state.T_world_body

    perturb = staticmethod(rigid.perturb)
    error = staticmethod(rigid.error)
    log_volume = staticmethod(rigid.log_volume)


def _rotate(R: Array, p: Array) -> Array:
    return jnp.einsum("...ij,...j->...i", R, p)


def _cross_matrix(a: Array) -> Array:
    """``a^ b = a x b``."""
    x, y, z = a
    return jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
