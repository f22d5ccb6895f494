"""Put a scan model into another frame: a map is seen from where its traversal began, a goal from the world's origin."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner


class PlacedScans(eqx.Module):
    """Ask a model at ``frame^-1 state``: a :class:`~vssm_gym.model.scan_model.ScanModel` whose frame lies elsewhere.

    Attributes:
        model: with states seen from its own frame.
        frame: pose of that frame: x, y (m), heading (rad).
    """

    model: ScanModel
    frame: Float[Array, "3"]

    @property
    def scanner(self) -> Scanner:
        """Return the scanner on the robot."""
        return self.model.scanner

    def ranges(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Return the ranges that the map's mean predicts, m."""
        return self.model.ranges(self._inside(state))

    def log_prob(self, ranges: Float[Array, "beams"], state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return ``log p(x | z, M)`` of a scan at the map's mean, nats."""
        return self.model.log_prob(ranges, self._inside(state))

    def sample(self, key: PRNGKeyArray, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Draw scans ``x ~ p(x | z, M)`` at the map's mean."""
        return self.model.sample(key, self._inside(state))

    def draw_map(self, key: PRNGKeyArray) -> "PlacedScans":
        """Return this model with a map drawn from ``q(M)``, as its mean."""
        return PlacedScans(self.model.draw_map(key), self.frame)

    def _inside(self, state: Array) -> Array:
        c, s = jnp.cos(self.frame[2]), jnp.sin(self.frame[2])
        dx, dy = state[..., 0] - self.frame[0], state[..., 1] - self.frame[1]
        heading = wrap_angle(state[..., 2] - self.frame[2])
        return jnp.stack([c * dx + s * dy, c * dy - s * dx, heading], axis=-1)
