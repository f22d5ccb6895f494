"""Planar holonomic robot: ``p(z' | z, u)`` of ``(x, y, heading)`` (SPEC 1(d), 6).

Control ``u = (turn, o, s)`` a step: ``heading' = heading + sign(turn) (|turn| + e_a)``,
``xy' = xy + [cos phi, sin phi] (s + e_s)``, ``phi = heading + o + e_a``; ``e_a`` acts on the heading only where the
robot turns, and nothing acts on a robot that does not try to move (TNP-SM).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry import inverse, matrix_to_planar, planar_to_matrix, se3_exp, se3_log, wrap_angle
from vssm_gym.transition.base import normal_log_prob, turn_log_volume


class MotionNoise(eqx.Module):
    """Standard deviations of a control step's execution, as the robot believes them."""

    turn: Float[Array, ""] | float  # sigma_a, rad
    step: Float[Array, ""] | float  # sigma_s, m


class PlanarBelief(eqx.Module):
    """``N(planar, covariance)`` over ``(x, y, heading)``; the error is in the body frame: ``T exp(xi)``."""

    planar: Float[Array, "3"]  # x, y (m, world), heading (rad)
    covariance: Float[Array, "3 3"]  # of xi = (forward, left, turn) in the body frame

    @property
    def mean(self) -> Float[Array, "3"]:
        """The pose the errors are measured from."""
        return self.planar


def planar_mean(planar: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """The noise-free motion: drive ``s`` along ``heading + o``, and turn."""
    turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
    phi = planar[..., 2] + offset
    return jnp.stack(
        [
            planar[..., 0] + step * jnp.cos(phi),
            planar[..., 1] + step * jnp.sin(phi),
            wrap_angle(planar[..., 2] + turn),
        ],
        axis=-1,
    )


def planar_predict(belief: PlanarBelief, control: Float[Array, "3"], noise: MotionNoise) -> PlanarBelief:
    """``int p(z' | z, u) N(z) dz`` to first order: the Gaussian after one control step.

    The rectification in the execution (noise never reverses a motion) is left out: it matters only for steps shorter
    than the noise. ``e_a`` moves both heading and direction, so the two are correlated: alike where the robot turns
    left, oppositely where it turns right.
    """
    turn, offset, step = control
    driving = step > 0.0
    c, s = jnp.cos(turn), jnp.sin(turn)
    # xi' = Ad(exp(u)^-1) xi: the old error seen from the new body frame
    dx, dy = step * jnp.cos(offset), step * jnp.sin(offset)
    F = jnp.array([[c, s, c * -dy + s * dx], [-s, c, s * dy + c * dx], [0.0, 0.0, 1.0]])
    # Columns: e_a and e_s as body-frame displacements after the turn
    along = jnp.array([jnp.cos(offset - turn), jnp.sin(offset - turn)])
    across = jnp.array([-along[1], along[0]])
    by_turn = jnp.concatenate([jnp.where(driving, step, 0.0) * across, jnp.sign(turn)[None]])
    by_step = jnp.concatenate([jnp.where(driving, 1.0, 0.0) * along, jnp.zeros(1)])
    Q = noise.turn**2 * jnp.outer(by_turn, by_turn) + noise.step**2 * jnp.outer(by_step, by_step)
    return PlanarBelief(planar_mean(belief.planar, control), F @ belief.covariance @ F.T + Q)


def perturb(planar: Float[Array, "*mean 3"], xi: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """``T exp(xi)``, xi = (forward, left, turn)."""
    zero = jnp.zeros_like(xi[..., 0])
    twist = jnp.stack([xi[..., 0], xi[..., 1], zero, zero, zero, xi[..., 2]], axis=-1)
    return matrix_to_planar(planar_to_matrix(planar) @ se3_exp(twist))


def error(mean: Float[Array, "*mean 3"], planar: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """``xi = log(T_mean^-1 T)``, (forward, left, turn)."""
    twist = se3_log(inverse(planar_to_matrix(mean)) @ planar_to_matrix(planar))
    return jnp.stack([twist[..., 0], twist[..., 1], twist[..., 5]], axis=-1)


def log_volume(xi: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """``log |det Jr|`` of SE(2)."""
    return turn_log_volume(xi[..., 2] ** 2)


class Planar(eqx.Module):
    """The planar robot as a :class:`~vssm_gym.transition.base.Transition`; controls (..., 3) = (turn, o, s).

    Two errors a step move three coordinates, so the execution alone has no density: ``slip``, what the motion model
    misses, gives it one.
    """

    noise: MotionNoise
    slip: tuple[float, float, float] = (0.004, 0.004, 0.002)  # stds a step: forward (m), left (m), turn (rad)

    def sample(
        self, key: PRNGKeyArray, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch 3"]:
        """A step as executed, noise that never reverses a motion included, then slip."""
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        by_execution, by_slip = jax.random.split(key)
        e = jax.random.normal(by_execution, (2, *state.shape[:-1]))
        e_a, e_s = e[0] * self.noise.turn, e[1] * self.noise.step
        turned = jnp.sign(turn) * jnp.maximum(0.0, jnp.abs(turn) + e_a)
        moved = jnp.where(step > 0.0, jnp.maximum(0.0, step + e_s), 0.0)
        executed = planar_mean(state, jnp.stack([turned, offset + e_a, moved], axis=-1))
        return perturb(executed, jax.random.normal(by_slip, state.shape) * jnp.asarray(self.slip))

    def log_prob(
        self, following: Float[Array, "*batch 3"], state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Of the first-order Gaussian of :func:`planar_predict` with slip: rectification is left out."""

        def one(following, state, control):
            known = PlanarBelief(state, jnp.zeros((3, 3)))
            predicted = planar_predict(known, control, self.noise)
            xi = error(predicted.planar, following)
            covariance = predicted.covariance + jnp.diag(jnp.asarray(self.slip) ** 2)
            return normal_log_prob(xi, covariance) - log_volume(xi)

        return jnp.vectorize(one, signature="(n),(n),(n)->()")(following, state, control)

    def pose(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4 4"]:
        """``T_world_body`` on the floor."""
        return planar_to_matrix(state)

    perturb = staticmethod(perturb)
    error = staticmethod(error)
    log_volume = staticmethod(log_volume)
