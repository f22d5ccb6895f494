"""Model the errors of a planar robot that drifts: they have a mean, and grow with the motion that is commanded."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.model.transition.rectified import rectified

Errors = tuple[float, float, float]
"""Of a motion: along the direction of travel (m), to its left (m), and of the heading (rad)."""


class BiasedNoise(eqx.Module):
    """Hold mean and standard deviation of the errors of a reference drive and of a reference turn (eq. M23).

    With ``d = s / drive_length`` and ``r = |turn| / turn_angle``, independent,

        e_a, e_c ~ N(d mean_drive + r mean_turn, d std_drive^2 + r std_turn^2)       along, to the left
        e_r ~ N(d mean_drive, d std_drive^2),    e_t ~ N(r mean_turn, r std_turn^2)  of the heading

    Attributes:
        drive_mean: of a drive of ``drive_length``; the heading's is positive to the left.
        drive_std: likewise.
        turn_mean: of a turn by ``turn_angle``, along and left of the heading; the heading's is positive where the turn
            overshoots.
        turn_std: likewise.
        drive_length: m.
        turn_angle: rad.
    """

    drive_mean: Errors
    drive_std: Errors
    turn_mean: Errors
    turn_std: Errors
    drive_length: float
    turn_angle: float

    normals: ClassVar[int] = 4  # a step draws

    def executed(self, control: Float[Array, "*batch 3"], normal: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3"]:
        """Return the control ``(turn, o, s)`` that would have led without noise to where this one leads.

        Of a turn on the spot, ``o`` is relative to the heading, whatever the frame of the command.

        Args:
            control: as commanded.
            normal: standard normals of the errors along, across, of the drive's and of the turn's heading.

        Returns:
            The control with this noise, rad, rad, m.
        """
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        mean, std = self._errors(control)
        e_a, e_c, e_r, e_t = jnp.moveaxis(mean + std * normal, -1, 0)
        turned = jnp.sign(turn) * jnp.maximum(0.0, jnp.abs(turn) + e_t) + e_r
        along = jnp.where(step > 0.0, jnp.maximum(0.0, step + e_a), e_a)
        direction = jnp.where(step > 0.0, offset, 0.0)
        return jnp.stack([turned, direction + jnp.arctan2(e_c, along), jnp.hypot(along, e_c)], axis=-1)

    def moments(self, control: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Return the expected control, and the covariance of (displacement along and across it, turn).

        Args:
            control: as commanded.

        Returns:
            The control without noise that leads to the expected pose, rad, rad, m; and the covariance, m and rad.
        """
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        mean, std = self._errors(control)
        turned, driven = (
            rectified(jnp.abs(turn) + mean[..., 3], std[..., 3]),
            rectified(step + mean[..., 0], std[..., 0]),
        )
        drives, turns = step > 0.0, turn != 0.0
        along, across = jnp.where(drives, driven.mean, mean[..., 0]), mean[..., 1]
        variances = [
            jnp.where(drives, driven.variance, std[..., 0] ** 2),
            std[..., 1] ** 2,
            jnp.where(turns, turned.variance, 0.0) + std[..., 2] ** 2,
        ]
        bias = jnp.arctan2(across, along)  # of the expected direction, to the left of the commanded one
        c, s = jnp.cos(bias), jnp.sin(bias)
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        rows = [[c, s, zero], [-s, c, zero], [zero, zero, one]]
        axes = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
        covariance = jnp.einsum("...ij,...j,...kj->...ik", axes, jnp.stack(variances, axis=-1), axes)
        heading = jnp.sign(turn) * turned.mean + mean[..., 2]
        direction = jnp.where(drives, offset, 0.0) + bias
        return jnp.stack([heading, direction, jnp.hypot(along, across)], axis=-1), covariance

    def _errors(self, control: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 4"], Float[Array, "*batch 4"]]:
        """Return mean and standard deviation of ``(e_a, e_c, e_r, e_t)``."""
        d, r = control[..., 2:] / self.drive_length, jnp.abs(control[..., :1]) / self.turn_angle
        driving, turning = jnp.array([*self.drive_mean, 0.0]), jnp.array([*self.turn_mean[:2], 0.0, self.turn_mean[2]])
        mean = d * driving + r * turning
        driving, turning = jnp.array([*self.drive_std, 0.0]), jnp.array([*self.turn_std[:2], 0.0, self.turn_std[2]])
        return mean, jnp.sqrt(d * driving**2 + r * turning**2)
