"""Evaluate ``V(x, y, heading)``, the discounted number of motions to the goal, between grid poses (eq. P21)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.planning.value_iteration.counts import Counts

LEAST_WEIGHT = 1e-3  # sum of the weights with a path to the goal; what is less is rounding


class CostToGo(eqx.Module):
    """Hold the cost-to-go on a grid of poses: trilinear between them, periodic in heading.

    ``V = (1 - gamma^n) / (1 - gamma)`` where the goal is ``n`` motions away; 0 at the goal; ``1 / (1 - gamma)``, the
    cost of driving forever, in collision, where no motion leads to the goal, and beyond the grid.
    """

    values: Float[Array, "nx ny headings"]  # float32; heading k is k 2 pi / headings
    origin: Float[Array, "2"]  # world position of the centre of cell (0, 0), m
    resolution: Float[Array, ""]  # m
    gamma: float = eqx.field(static=True)  # discount of one motion
    motion_length: float = eqx.field(static=True)  # m that one motion of cost 1 drives
    counts: Counts | None = None  # k: how many motions one counts; None: one everywhere

    @property
    def never(self) -> float:
        """``1 / (1 - gamma)``: the cost of never arriving."""
        return 1.0 / (1.0 - self.gamma)

    def at(self, planar: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return ``V`` at poses ``(..., 3)``, m and rad; JAX for JAX arrays, else NumPy; differentiable within cells.

        The weights have the precision of the poses; those of float32 give JAX's value to the last bit.

        Poses of the grid that collide or have no path to the goal are left out of the mean, and the weights of the
        others grow to 1, so that a wall does not raise the cost of a free pose beside it. The obstacle of a heading is
        wider than the car, so the poses between which another lies are all on one side of it. Where none of the eight
        has a path the value jumps to :attr:`never`.
        """
        xp = _library(planar)
        values = xp.asarray(self.values)
        corners, inside = self._corners(planar)
        share = total = 0.0
        for index, weight in corners:
            value = values[index]
            counted = xp.where(value < np.float32(self.never), weight, 0.0)
            share, total = share + counted, total + counted * value
        known = inside & (share > LEAST_WEIGHT)
        return xp.where(known, total / xp.where(known, share, 1.0), self.never).astype(np.float32)

    def counted(self, planar: Float[Array, "*batch 3"], ahead: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Return ``k`` of motions at poses ``(..., 3)``, m and rad, ahead or back by the sign of ``ahead``."""
        xp = _library(planar)
        if self.counts is None:
            return xp.ones_like(ahead)
        nx, ny, n = self.counts.poses.shape
        origin, resolution = xp.asarray(self.origin), xp.asarray(self.resolution)
        i = xp.clip(xp.round((planar[..., 0] - origin[0]) / resolution), 0, nx - 1).astype(np.int32)
        j = xp.clip(xp.round((planar[..., 1] - origin[1]) / resolution), 0, ny - 1).astype(np.int32)
        k = xp.round(planar[..., 2] * (n / (2.0 * np.pi))).astype(np.int32) % n
        number = xp.asarray(self.counts.number)[xp.where(ahead >= 0.0, 0, 1)]
        return xp.where(xp.asarray(self.counts.poses)[i, j, k], number, xp.ones_like(number))

    def reachable(self, planar: Float[Array, "*batch 3"]) -> Array:
        """Return True where any of the eight poses of the grid around a pose has a path to the goal, ``(...)`` bool."""
        return self.at(planar) < np.float32(self.never)

    def _corners(self, planar: Array) -> tuple[list[tuple[tuple[Array, Array, Array], Array]], Array]:
        """Return the indices and weights of the eight poses around each pose, and which poses lie within the grid."""
        xp = _library(planar)
        precision = np.float32 if xp is jnp else np.promote_types(np.asarray(planar).dtype, np.float32)
        planar = xp.asarray(planar, dtype=np.float32)
        origin, resolution = xp.asarray(self.origin), xp.asarray(self.resolution)
        nx, ny, n = self.values.shape
        x, y = (planar[..., 0] - origin[0]) / resolution, (planar[..., 1] - origin[1]) / resolution
        h = planar[..., 2] * (n / (2.0 * np.pi))
        inside = (x >= 0.0) & (x <= nx - 1.0) & (y >= 0.0) & (y <= ny - 1.0)
        i = xp.clip(xp.floor(x), 0, nx - 2).astype(np.int32)
        j = xp.clip(xp.floor(y), 0, ny - 2).astype(np.int32)
        k = xp.floor(h).astype(np.int32)
        a, b, c = (part - index.astype(precision) for part, index in ((x, i), (y, j), (h, k)))
        along_x, along_y = ((i, 1.0 - a), (i + 1, a)), ((j, 1.0 - b), (j + 1, b))
        around = ((k % n, 1.0 - c), ((k + 1) % n, c))
        corners = [((u, v, w), wu * wv * ww) for u, wu in along_x for v, wv in along_y for w, ww in around]
        return corners, inside


def _library(planar: object) -> Any:
    """Return ``jax.numpy`` for JAX's arrays, traced ones too, else NumPy."""
    return jnp if isinstance(planar, jax.Array) else np
