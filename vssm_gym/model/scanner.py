"""Hold a planar laser scanner: where its beams point, where it sits on the robot, how far it measures."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.model.transition.odometry import Odometry


class Scanner(eqx.Module):
    """Hold a planar laser scanner on a robot.

    Attributes:
        angles: of the beams on the robot, counter-clockwise from ahead, rad; evenly spaced.
        mount: pose on the robot: forward, left (m), turn (rad).
        max_range: m.
    """

    angles: Float[Array, "beams"]
    mount: Float[Array, "3"]
    max_range: Float[Array, ""]

    def pose(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Return the scanner's pose of a robot's, x, y (m), heading (rad)."""
        return Odometry((0.0, 0.0, 0.0)).mean(state, jnp.broadcast_to(self.mount, state.shape), 0.0)

    def endpoints(self, state: Float[Array, "3"], ranges: Float[Array, "beams"]) -> Float[Array, "beams 2"]:
        """Return where the beams of a scan end, m."""
        at = self.pose(state)
        angle = at[2] + self.angles
        return at[:2] + ranges[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
