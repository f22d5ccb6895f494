"""Model a body that carries an IMU: ``p(z' | z, u)`` driven by gyroscope and accelerometer (VSSM-LM).

    v' = v + (R a + g) dt      t' = t + (v + v') dt / 2      R' = R exp(w_b dt)      w' = R' w_b

``u = (a, w_b)``: specific force and rate in the body frame, biases removed; ``g = (0, 0, -9.81)`` in the world.
Velocities in the state are in the world frame, as of :mod:`vssm_gym.model.transition.rigid`, whose states these are.
The pose moves by the mean of the two velocities, which integrates a constant acceleration exactly at any rate. Gaussian
noise is added to the new velocity, and moves the new pose by ``exp(e)``, e in the body frame.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vssm_gym.geometry.gravity import GRAVITY
from vssm_gym.model.transition.base import QUOTED_STEP, Transition
from vssm_gym.model.transition.manifold import RIGID, RigidState
from vssm_gym.model.transition.rigid import nearest_rotation


class ImuNoise(eqx.Module):
    """Hold standard deviations of a step of 0.1 s (VSSM-LM); variances are proportional to ``dt``.

    Attributes:
        location: of the position, m.
        orientation: of the orientation, rad.
        velocity: of the linear velocity, m/s.
        rate: of the angular velocity that the gyroscope reads, rad/s.
    """

    location: Float[Array, ""] | float = 0.01
    orientation: Float[Array, ""] | float = 0.001
    velocity: Float[Array, ""] | float = 0.001
    rate: Float[Array, ""] | float = 0.001

    def variances(self, dt: float | Array) -> Float[Array, "12"]:
        """Return the variances that a step adds (eq. M20).

        Args:
            dt: length of the step, s.

        Returns:
            Of translation (m^2), rotation (rad^2), linear and angular velocity, three each.
        """
        stds = [jnp.full(3, std) for std in (self.location, self.orientation, self.velocity, self.rate)]
        return jnp.concatenate(stds) ** 2 * (dt / QUOTED_STEP)


class Imu(Transition):
    """Model a body in space that is driven by the readings of an IMU, biases removed.

    States are those of :class:`Rigid`: ``T_world_body`` and velocities in the world, z up. Controls are ``(a, w_b)``:
    specific force (m/s^2) and angular rate (rad/s), body frame.
    """

    noise: ImuNoise = ImuNoise()

    manifold = RIGID
    controls = 6
    commanded = False  # velocity errors grow without bound: prediction needs images

    def mean(self, state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array) -> RigidState:
        """Integrate the readings; the gyroscope's rate replaces the old angular velocity (eq. M22)."""
        R, t = state.T_world_body[..., :3, :3], state.T_world_body[..., :3, 3]
        v = state.velocity[..., :3]
        v_after = v + (_rotate(R, control[..., :3]) + jnp.asarray(GRAVITY)) * dt
        R_after = nearest_rotation(R @ jaxlie.SO3.exp(control[..., 3:] * dt).as_matrix())
        top = jnp.concatenate([R_after, (t + 0.5 * (v + v_after) * dt)[..., None]], axis=-1)
        T = state.T_world_body.at[..., :3, :].set(top)
        return RigidState(T, jnp.concatenate([v_after, _rotate(R_after, control[..., 3:])], axis=-1))

    def jacobian(self, state: RigidState, control: Float[Array, "6"], dt: float | Array) -> Float[Array, "12 12"]:
        """``dr' = exp(-w_b h) dr``, ``dv' = dv - h R a^ dr``, ``h`` the step.

        ``dt' = R'^T (R dt + h dv - h^2/2 R a^ dr)``, ``dw' = -R' w_b^ dr'``.
        """
        R, R_after = state.T_world_body[:3, :3], self.mean(state, control, dt).T_world_body[:3, :3]
        turned_back = R_after.T @ R
        tilt = -R @ _cross_matrix(control[:3]) * dt  # d v' / d dr: the force turns with the body
        spin = -R_after @ _cross_matrix(control[3:]) @ turned_back
        zero, one = jnp.zeros((3, 3)), jnp.eye(3)
        return jnp.block(
            [
                [turned_back, 0.5 * dt * R_after.T @ tilt, dt * R_after.T, zero],
                [zero, turned_back, zero, zero],
                [zero, tilt, one, zero],
                [zero, spin, zero, zero],
            ]
        )

    def noise_covariance(
        self, state: RigidState, control: Float[Array, "6"], dt: float | Array
    ) -> Float[Array, "12 12"]:
        """Return the diagonal of pose and velocity noise."""
        return jnp.diag(self.noise.variances(dt))


def _rotate(R: Array, p: Array) -> Array:
    return jnp.einsum("...ij,...j->...i", R, p)


def _cross_matrix(a: Array) -> Array:
    """``a^ b = a x b``."""
    x, y, z = a
    return jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
