"""Provide a rectangular room with a round pillar, whose scans are a formula: a differentiable model of scans."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vssm_gym.model.scanner import Scanner


def full_circle(beams: int = 64, max_range: float = 1.5) -> Scanner:
    """Return a scanner in the middle of a robot, with beam 0 ahead."""
    angles = 2.0 * np.pi * np.arange(beams) / beams
    return Scanner(jnp.asarray(angles, jnp.float32), jnp.zeros(3), jnp.float32(max_range))


class AnalyticRoom(eqx.Module):
    """Predict scans of the room ``[0, width] x [0, depth]`` with a pillar; a ScanModel.

    Attributes:
        scanner: on the robot.
        width: m, along x.
        depth: m, along y.
        pillar: x, y, radius, m; a radius of 0: none.
        scale: ``b`` of a reading's Laplace distribution, m.
    """

    scanner: Scanner
    width: float = 1.0
    depth: float = 0.6
    pillar: tuple[float, float, float] = (0.3, 0.4, 0.06)
    scale: float = 0.01

    def ranges(self, state: Array) -> Array:
        """Return the exact ranges."""
        angle = state[..., 2:3] + self.scanner.angles
        ux, uy = jnp.cos(angle), jnp.sin(angle)
        x, y = state[..., 0:1], state[..., 1:2]
        along = lambda p, u, far: jnp.where(u > 0.0, far - p, p) / jnp.maximum(jnp.abs(u), 1e-6)
        wall = jnp.minimum(along(x, ux, self.width), along(y, uy, self.depth))
        px, py, radius = self.pillar
        dx, dy = px - x, py - y
        ahead, beside = dx * ux + dy * uy, dx * uy - dy * ux
        root = radius**2 - beside**2
        hit = (root > 0.0) & (ahead > 0.0)
        inside = (dx**2 + dy**2 < radius**2) & (ahead < jnp.inf)
        met = jnp.where(inside, 0.0, jnp.where(hit, ahead - jnp.sqrt(jnp.where(hit, root, 1.0)), jnp.inf))
        return jnp.clip(jnp.minimum(wall, met), 1e-6, self.scanner.max_range)

    def log_prob(self, ranges: Array, state: Array) -> Array:
        """Return the log density of a scan at each pose."""
        nats = -jnp.abs(ranges - self.ranges(state)) / self.scale - jnp.log(2.0 * self.scale)
        return 0.2 * jnp.sum(jnp.where(ranges > 0.0, nats, 0.0), axis=-1)

    def sample(self, key: Array, state: Array) -> Array:
        """Draw scans."""
        found = self.ranges(state)
        return jnp.clip(found + self.scale * jax.random.laplace(key, found.shape), 0.0, self.scanner.max_range)

    def draw_map(self, key: Array) -> "AnalyticRoom":
        """Return this model: its map is known."""
        return self
