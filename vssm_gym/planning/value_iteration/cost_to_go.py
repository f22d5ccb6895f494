"""``V(x, y, heading)``: the discounted number of motions to the goal, between the poses of a grid."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class CostToGo(eqx.Module):
    """Cost-to-go on a grid of poses: trilinear between them, periodic in heading.

    ``V = (1 - gamma^n) / (1 - gamma)`` where the goal is ``n`` motions away; 0 at the goal; ``1 / (1 - gamma)``, the
    cost of driving forever, in collision, where no motion leads to the goal, and beyond the grid.
    """

    values: Float[Array, "nx ny headings"]  # float32; heading k is k 2 pi / headings
    origin: Float[Array, "2"]  # world position of the centre of cell (0, 0), m
    resolution: Float[Array, ""]  # m
    gamma: float = eqx.field(static=True)  # discount of one motion
    motion_length: float = eqx.field(static=True)  # m that one motion of cost 1 drives

    @property
    def never(self) -> float:
        """``1 / (1 - gamma)``: the cost of never arriving."""
        return 1.0 / (1.0 - self.gamma)

    def at(self, planar: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """``V`` at poses ``(..., 3)``, m and rad; JAX for JAX arrays, else numpy; differentiable between grid planes.

        A pose one of whose eight neighbours collides is charged that neighbour's share of :attr:`never`: within a cell
        of a wall the value rises steeply, from what a map can resolve to what cannot be driven.
        """
        xp = _library(planar)
        values = xp.asarray(self.values)
        corners, inside = self._corners(planar)
        found = sum(weight * values[index] for index, weight in corners)
        return xp.where(inside, found, self.never).astype(np.float32)

    def reachable(self, planar: Float[Array, "*batch 3"]) -> Array:
        """Whether any of the poses of the grid between which a pose lies has a way to the goal, ``(...)`` bool."""
        xp = _library(planar)
        values = xp.asarray(self.values)
        corners, inside = self._corners(planar)
        # not a comparison of the interpolated value, which rounds
        ways = [(values[index] < np.float32(self.never)) & (weight > 0.0) for index, weight in corners]
        return inside & xp.any(xp.stack(ways), axis=0)

    def _corners(self, planar: Array) -> tuple[list[tuple[tuple[Array, Array, Array], Array]], Array]:
        """Indices and weights of the eight poses around each pose, and which poses lie within the grid."""
        xp = _library(planar)
        planar = xp.asarray(planar, dtype=np.float32)
        origin, resolution = xp.asarray(self.origin), xp.asarray(self.resolution)
        nx, ny, n = self.values.shape
        x, y = (planar[..., 0] - origin[0]) / resolution, (planar[..., 1] - origin[1]) / resolution
        h = planar[..., 2] * (n / (2.0 * np.pi))
        inside = (x >= 0.0) & (x <= nx - 1.0) & (y >= 0.0) & (y <= ny - 1.0)
        i = xp.clip(xp.floor(x), 0, nx - 2).astype(np.int32)
        j = xp.clip(xp.floor(y), 0, ny - 2).astype(np.int32)
        k = xp.floor(h).astype(np.int32)
        a, b, c = x - i, y - j, h - k
        along_x, along_y = ((i, 1.0 - a), (i + 1, a)), ((j, 1.0 - b), (j + 1, b))
        around = ((k % n, 1.0 - c), ((k + 1) % n, c))
        corners = [((u, v, w), wu * wv * ww) for u, wu in along_x for v, wv in along_y for w, ww in around]
        return corners, inside


def _library(planar: object) -> Any:
    """``jax.numpy`` for JAX's arrays, traced ones too, else numpy."""
    return jnp if isinstance(planar, jax.Array) else np
