"""Hold an occupancy map of the plane: independent Gaussians at the corners of a grid, as the voxel map's are.

occupancy   m, the signed distance behind the nearest surface along a ray, in a band around it; negative where free
precision   m^-2; a cell that was never observed has the prior's
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, PRIOR_OCCUPANCY_MEAN, PRIOR_OCCUPANCY_STD

MOST_PLANAR_CELLS = 40_000_000  # 320 MB


class PlanarMap(eqx.Module):
    """Represent ``q(M)`` of a plane.

    Attributes:
        occupancy: means, m.
        precision: of each.
        origin: x, y of the first cell's centre, m.
        cell_size: m.
    """

    occupancy: Float[Array, "nx ny"]
    precision: Float[Array, "nx ny"]
    origin: Float[Array, "2"]
    cell_size: Float[Array, ""]

    @classmethod
    def prior(cls, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], cell_size: float) -> "PlanarMap":
        """Return a map of which nothing is known.

        Args:
            low: x, y of its first cell, m.
            high: beyond which it ends.
            cell_size: m.

        Raises:
            InputError: no cells, or too many.
        """
        shape = np.ceil((np.asarray(high) - low) / cell_size).astype(int) + 1 if cell_size > 0.0 else np.zeros(2, int)
        if not (shape >= 2).all() or shape.prod() > MOST_PLANAR_CELLS:
            found = f"found {' x '.join(map(str, shape))}"
            raise InputError("planar map", "cell_size", f"2 x 2 to {MOST_PLANAR_CELLS:,} cells; {found}")
        nx, ny = shape.tolist()
        mean, precision = jnp.full((nx, ny), PRIOR_OCCUPANCY_MEAN), jnp.full((nx, ny), PRIOR_OCCUPANCY_STD**-2)
        return cls(mean, precision, jnp.asarray(low, jnp.float32), jnp.float32(cell_size))

    @property
    def observed(self) -> np.ndarray:
        """Return which cells were observed, ``(nx, ny)`` bool."""
        return np.asarray(self.precision) > OBSERVED_PRECISION

    def occupancy_at(self, xy: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
        """Return the bilinear mean; outside of the grid that of its nearest border."""
        return self._corners(xy)[0]

    def slope_at(self, xy: Float[Array, "*batch 2"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 2"]]:
        """Return the bilinear mean and its gradient in x and y."""
        return self._corners(xy)

    def known_at(self, xy: Float[Array, "*batch 2"]) -> Array:
        """Return whether all four cells around a point were observed."""
        i, j, _ = self._cell(xy)
        seen = self.precision > OBSERVED_PRECISION
        inside = jnp.all((xy >= self.origin) & (xy <= self.origin + self.cell_size * self._last()), axis=-1)
        return seen[i, j] & seen[i + 1, j] & seen[i, j + 1] & seen[i + 1, j + 1] & inside

    def centres(self) -> Float[Array, "nx ny 2"]:
        """Return x, y of every cell's centre, m."""
        nx, ny = self.occupancy.shape
        grid = jnp.stack(jnp.meshgrid(jnp.arange(nx), jnp.arange(ny), indexing="ij"), axis=-1)
        return self.origin + self.cell_size * grid

    def _last(self) -> Float[Array, "2"]:
        return jnp.asarray(self.occupancy.shape, jnp.float32) - 1.0

    def _cell(self, xy: Array) -> tuple[Array, Array, Array]:
        """Return the numbers of the lower cell, and where between it and the next a point lies."""
        at = jnp.clip((xy - self.origin) / self.cell_size, 0.0, self._last())
        low = jnp.minimum(jnp.floor(at), self._last() - 1.0)
        return low[..., 0].astype(int), low[..., 1].astype(int), at - low

    def _corners(self, xy: Array) -> tuple[Array, Array]:
        i, j, share = self._cell(xy)
        m, (u, v) = self.occupancy, (share[..., 0], share[..., 1])
        a, b, c, d = m[i, j], m[i + 1, j], m[i, j + 1], m[i + 1, j + 1]
        mean = (1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d)
        along_x, along_y = (1.0 - v) * (b - a) + v * (d - c), (1.0 - u) * (c - a) + u * (d - b)
        return mean, jnp.stack([along_x, along_y], axis=-1) / self.cell_size
