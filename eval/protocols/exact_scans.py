"""Predict the scans of a maze exactly: the true map behind the contract of learned ones, for the bound of a planner."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.envs.physics.planar import scan
from vssm_gym.model.scanner import Scanner


class ExactScans(eqx.Module):
    """Cast the rays of the simulator: a :class:`~vssm_gym.model.scan_model.ScanModel` without uncertainty.

    Attributes:
        rectangles: the maze's walls, see :mod:`vssm_gym.envs.physics.planar`.
        scanner: on the robot; beams evenly spaced over a full circle, the first ahead.
        scale: ``b`` of the Laplace distribution of a reading, m.
    """

    rectangles: Float[Array, "m 6"]
    scanner: Scanner
    scale: float = 0.005

    def ranges(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Return the exact ranges, m."""
        beams = len(self.scanner.angles)

        def cast(rectangles: np.ndarray, poses: np.ndarray) -> np.ndarray:
            rows = np.asarray(poses, np.float64).reshape(-1, 3)
            found = scan(rows, np.asarray(rectangles, np.float64), beams).astype(np.float32)
            return found.reshape(*poses.shape[:-1], beams)

        shape = jax.ShapeDtypeStruct((*state.shape[:-1], beams), jnp.float32)
        found = jax.pure_callback(cast, shape, self.rectangles, state, vmap_method="sequential")
        return jnp.clip(found, 1e-6, self.scanner.max_range)

    def log_prob(self, ranges: Float[Array, "beams"], state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density of the beams that have measured, nats."""
        nats = -jnp.abs(ranges - self.ranges(state)) / self.scale - jnp.log(2.0 * self.scale)
        return jnp.sum(jnp.where(ranges > 0.0, nats, 0.0), axis=-1)

    def sample(self, key: PRNGKeyArray, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Draw scans."""
        found = self.ranges(state)
        return jnp.clip(found + self.scale * jax.random.laplace(key, found.shape), 0.0, self.scanner.max_range)

    def draw_map(self, key: PRNGKeyArray) -> "ExactScans":
        """Return this model: the true map has one draw."""
        return self
