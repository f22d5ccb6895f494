"""Model the errors of a planar robot as TNP-SM does: one of the direction and one of the distance, a step."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.model.transition.rectified import rectified


class MotionNoise(eqx.Module):
    """Hold standard deviations of a control step's execution, as the robot believes them (eq. M23).

    Attributes:
        turn: of the direction of travel, and of the heading where the robot turns, rad.
        step: of the distance travelled, m.
    """

    turn: Float[Array, "*batch"] | float  # sigma_a
    step: Float[Array, "*batch"] | float  # sigma_s

    normals: ClassVar[int] = 2  # a step draws

    def executed(self, control: Float[Array, "*batch 3"], normal: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Return the control ``(turn, o, s)`` that would have led without noise to where this one leads.

        Args:
            control: as commanded.
            normal: standard normals for the direction and for the distance.

        Returns:
            The control with this noise, rad, rad, m.
        """
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        e_a, e_s = normal[..., 0] * self.turn, normal[..., 1] * self.step
        turned = jnp.sign(turn) * jnp.maximum(0.0, jnp.abs(turn) + e_a)
        moved = jnp.where(step > 0.0, jnp.maximum(0.0, step + e_s), 0.0)
        return jnp.stack([turned, offset + e_a, moved], axis=-1)

    def moments(self, control: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Return the expected control, and the covariance of (displacement along and across it, turn).

        Args:
            control: as commanded.

        Returns:
            The control without noise that leads to the expected pose, rad, rad, m; and the covariance, m and rad.
        """
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        turned, moved = rectified(jnp.abs(turn), self.turn), rectified(step, self.step)
        turns, drives = jnp.abs(jnp.sign(turn)), jnp.where(step > 0.0, 1.0, 0.0)
        # Moments of the direction's error: E[cos e] = k, E[cos^2 e] = (1 + k^4) / 2, E[e sin e] = k sigma^2
        k = jnp.exp(-0.5 * jnp.asarray(self.turn) ** 2)
        square = moved.variance + moved.mean**2
        along = jnp.maximum(0.5 * square * (1.0 + k**4) - (k * moved.mean) ** 2, 0.0)
        across = 0.5 * square * (1.0 - k**4)
        both = jnp.sign(turn) * drives * k * moved.mean * turned.with_noise
        zero = jnp.zeros_like(both)
        rows = [[drives * along, zero, zero], [zero, drives * across, both], [zero, both, turns * turned.variance]]
        covariance = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
        return jnp.stack([jnp.sign(turn) * turned.mean, offset, drives * k * moved.mean], axis=-1), covariance
