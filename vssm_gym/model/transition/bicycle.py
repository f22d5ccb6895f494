"""Model a car as a kinematic bicycle: ``p(z' | z, u)`` of ``(x, y, heading)`` at the rear axle (thesis, 5.6.1).

    T' = T exp(s, 0, s k),   s = (speed + e_v) dt,   k = tan(steering + e_d) / wheelbase

Under a constant control the rear axle drives an arc of length ``s`` and curvature ``k``, integrated exactly. Then slip
moves the pose by ``exp(e)``. The error of speed is proportional to speed: a car at rest does not creep.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.arc import arc_of
from vssm_gym.model.transition.base import QUOTED_STEP, Transition
from vssm_gym.model.transition.manifold import PLANAR


class BicycleNoise(eqx.Module):
    """Hold standard deviations of a step of 0.1 s; the variance of the displacement is proportional to ``dt``.

    Attributes:
        speed: proportion of the commanded speed.
        steering: of the steering angle, rad.
        slip_forward: along the body, m.
        slip_left: across it, m.
        slip_turn: of the heading, rad.
    """

    speed: Float[Array, ""] | float = 0.05
    steering: Float[Array, ""] | float = 0.02
    slip_forward: Float[Array, ""] | float = 0.002
    slip_left: Float[Array, ""] | float = 0.002
    slip_turn: Float[Array, ""] | float = 0.002

    def control_stds(self, control: Float[Array, "*batch 2"], dt: float | Array) -> Float[Array, "*batch 2"]:
        """Return standard deviations of the executed control: errors average out over a longer step.

        Args:
            control: speed (m/s) and steering (rad).
            dt: length of the step, s.

        Returns:
            Of speed (m/s) and steering (rad).
        """
        shrink = jnp.sqrt(QUOTED_STEP / dt)
        speed = self.speed * jnp.abs(control[..., 0]) * shrink
        return jnp.stack([speed, jnp.full_like(speed, self.steering) * shrink], axis=-1)

    def slip_variances(self, dt: float | Array) -> Float[Array, "3"]:
        """Return the variances of slip after a step (eq. M20).

        Args:
            dt: length of the step, s.

        Returns:
            Forward, left (m^2) and turn (rad^2).
        """
        return jnp.stack([jnp.asarray(s) for s in (self.slip_forward, self.slip_left, self.slip_turn)]) ** 2 * (
            dt / QUOTED_STEP
        )


def arc(control: Float[Array, "*batch 2"], dt: float | Array, wheelbase: float | Array) -> Float[Array, "*batch 3"]:
    """``exp(s, 0, s k)``: displacement (forward, left, m) and turn (rad) of one step, in the body frame at its start.

    Args:
        control: Speed (m/s, negative backwards) and steering angle (rad, left positive, |steering| < pi/2).
        dt: Length of the step, s.
        wheelbase: Between the axles, m.
    """
    s = control[..., 0] * dt
    turn = s * jnp.tan(control[..., 1]) / wheelbase
    return arc_of(s, turn)


class Bicycle(Transition):
    """Model a car that drives along an arc (kinematic bicycle).

    States are ``(x, y, heading)`` of the middle of the rear axle in the world, m and rad. Controls are ``(speed,
    steering)``: m/s, negative backwards; rad, positive to the left.

    Attributes:
        noise: of the execution, and slip.
        wheelbase: between the axles, m; the default is that of the QCar.
    """

    noise: BicycleNoise = BicycleNoise()
    wheelbase: Float[Array, ""] | float = 0.26

    manifold = PLANAR
    controls = 2
    commanded = True

    def mean(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 2"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Return ``(x, y, heading)`` at the end of :func:`arc`, heading in [-pi, pi; eq. M24)."""
        forward, left, turn = jnp.moveaxis(arc(control, dt, self.wheelbase), -1, 0)
        c, s = jnp.cos(state[..., 2]), jnp.sin(state[..., 2])
        x, y = state[..., 0] + c * forward - s * left, state[..., 1] + s * forward + c * left
        return jnp.stack([x, y, wrap_angle(state[..., 2] + turn)], axis=-1)

    def jacobian(self, state: Float[Array, "3"], control: Float[Array, "2"], dt: float | Array) -> Float[Array, "3 3"]:
        """``xi' = Ad(exp(u)^-1) xi``: the old error in the new body frame."""
        dx, dy, turn = arc(control, dt, self.wheelbase)
        c, s = jnp.cos(turn), jnp.sin(turn)
        return jnp.array([[c, s, c * -dy + s * dx], [-s, c, s * dy + c * dx], [0.0, 0.0, 1.0]])

    def noise_covariance(
        self, state: Float[Array, "3"], control: Float[Array, "2"], dt: float | Array
    ) -> Float[Array, "3 3"]:
        """``G Q G^T + slip`` in the body frame after the step, to first order in the errors of the control."""
        turn = arc(control, dt, self.wheelbase)[2]
        c, s = jnp.cos(turn), jnp.sin(turn)
        back = jnp.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        G = back @ jax.jacfwd(arc)(control, dt, self.wheelbase) * self.noise.control_stds(control, dt)
        return G @ G.T + jnp.diag(self.noise.slip_variances(dt))

    def sample(
        self, key: PRNGKeyArray, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 2"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Draw the arc of the executed control, then slip."""
        by_control, by_slip = jax.random.split(key)
        e = jax.random.normal(by_control, (*state.shape[:-1], 2)) * self.noise.control_stds(control, dt)
        slip = jax.random.normal(by_slip, state.shape) * jnp.sqrt(self.noise.slip_variances(dt))
        return PLANAR.perturb(self.mean(state, control + e, dt), slip)

    def mean_path(
        self, state: Float[Array, "3"], controls: Float[Array, "*batch time 2"], dt: float | Array
    ) -> Float[Array, "*batch time 3"]:
        """Return ``z_1 .. z_T``, headings not wrapped, of one or many sequences of controls.

        A bicycle's arc does not depend on its pose: headings are cumulative sums of turns, positions of rotated arcs.
        """
        arcs = arc(controls, dt, self.wheelbase)
        turned = state[2] + jnp.cumsum(arcs[..., 2], axis=-1)
        before = turned - arcs[..., 2]
        c, s = jnp.cos(before), jnp.sin(before)
        dx, dy = c * arcs[..., 0] - s * arcs[..., 1], s * arcs[..., 0] + c * arcs[..., 1]
        return jnp.stack([state[0] + jnp.cumsum(dx, -1), state[1] + jnp.cumsum(dy, -1), turned], axis=-1)
