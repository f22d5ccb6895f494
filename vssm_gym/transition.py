"""Transitions ``p(z_t+1 | z_t, u_t)`` of the model (SPEC 1, 6).

Planar holonomic robot, control ``u = (turn, o, s)`` a step: ``heading' = heading + sign(turn) (|turn| + e_a)``,
``xy' = xy + [cos phi, sin phi] (s + e_s)``, ``phi = heading + o + e_a``; ``e_a`` acts on the heading only where the
robot turns, and nothing acts on a robot that does not try to move (TNP-SM).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry import wrap_angle


class MotionNoise(eqx.Module):
    """Standard deviations of a control step's execution, as the robot believes them."""

    turn: Float[Array, ""] | float  # sigma_a, rad
    step: Float[Array, ""] | float  # sigma_s, m


class PlanarBelief(eqx.Module):
    """``N(planar, covariance)`` over ``(x, y, heading)``; the error is in the body frame: ``T exp(xi)``."""

    planar: Float[Array, "3"]  # x, y (m, world), heading (rad)
    covariance: Float[Array, "3 3"]  # of xi = (forward, left, turn) in the body frame


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
