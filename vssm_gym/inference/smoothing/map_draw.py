"""``M ~ q(M) = prod_cells N(mean, std^2)``: sample independent cells only where rays read them (VSSM-LM, section 4).

    cell = mean + std eps(key, position),    f_M(p) = trilinear interpolation of the eight cells around p

The standard normal ``eps`` of a cell is a function of the draw's key and of the cell's position in storage: a
counter-based generator (Salmon et al., SC 2011). All rays of a draw see the same cell there, and nothing is stored, so
that a draw costs the same in a map of any size. Integers are mixed by Wellons' ``lowbias32`` (2018), once for each word
of the key, and become normal by the inverse of their distribution, as in :func:`jax.random.normal`.

The random map is that of the stored cells. Blocks without storage and the space outside of the grid are the constant
field of the prior's mean, in every draw and for every ``q``.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from vssm_gym.inference.smoothing.colour_network import ColourNetwork
from vssm_gym.maps.block_table import CELLS
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_MEAN, VoxelMap, trilinear


class MapDraw(eqx.Module):
    """Represent one draw ``M ~ q(M)`` as a field that can be rendered (:func:`vssm_gym.model.emission.trace`).

    Its queries are those of :class:`VoxelMap`, and differentiable in the means and precisions of the cells.

    Attributes:
        m: ``q(M)``; its precisions are those of the cells, 1 / std^2.
        occupancy_words: of the draw's key, for occupancies.
        colour_words: the same for colours.
        network: that paints the map instead of its cells; None: they have colours.
    """

    m: VoxelMap
    occupancy_words: UInt32[Array, "2"]
    colour_words: UInt32[Array, "2"]
    network: ColourNetwork | None = None

    @classmethod
    def of(cls, key: PRNGKeyArray, m: VoxelMap, network: ColourNetwork | None = None) -> "MapDraw":
        """Return the draw that belongs to a key."""
        words = jax.random.bits(key, (2, 2))
        return cls(m, words[0], words[1], network)

    @property
    def voxel_size(self) -> Float[Array, ""]:
        """Return the edge of a cell, m."""
        return self.m.voxel_size

    def occupancy_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Interpolate the drawn occupancy at points (m): negative signed distance, m."""
        offsets, fraction, inside = self.m.corners(p_world)
        at = jnp.stack(offsets)
        drawn = _drawn(self.m.occupancy, self.m.occupancy_precision, at, at, self.occupancy_words)
        cells = jnp.where(self._stored(at), drawn, PRIOR_OCCUPANCY_MEAN)
        return jnp.where(inside, trilinear(list(cells), *fraction), PRIOR_OCCUPANCY_MEAN)

    def colour_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Interpolate the drawn colour at points (m), or ask the network: RGB, not limited to [0, 1]."""
        if self.network is not None:
            return self.network(p_world)
        offsets, fraction, inside = self.m.corners(p_world)
        at = jnp.stack(offsets)[..., None]
        # A row holds three planes of cells: from row CELLS + cell to (3 row + channel) CELLS + cell.
        planes = at + 2 * (at & -CELLS) + CELLS * jnp.arange(3)
        drawn = _drawn(self.m.colour, self.m.colour_precision, planes, at, self.colour_words)
        cells = jnp.where(self._stored(at), drawn, 0.0)
        return jnp.where(inside[..., None], trilinear(list(cells), *(f[..., None] for f in fraction)), 0.0)

    def _stored(self, position: Array) -> Array:
        """Return which cells have storage of their own."""
        return jnp.ones(position.shape, bool) if self.m.table is None else position >= CELLS


def cell_normals(words: UInt32[Array, "2"], position: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """``eps ~ N(0, 1)`` of positions in storage: independent between arguments (eq. I57).

    Args:
        words: two random words, the key.
        position: of cells.
    """
    bits = _mixed(_mixed(position.astype(jnp.uint32) ^ words[0]) + words[1])
    # The odd multiples of 2^-24 in (-1, 1): symmetric, and exact in float32
    uniform = (bits >> 8).astype(jnp.float32) * 2.0**-23 - (1.0 - 2.0**-24)
    return jnp.sqrt(2.0) * jax.lax.erf_inv(uniform)


def _mixed(x: UInt32[Array, "*batch"]) -> UInt32[Array, "*batch"]:
    """Mix the bits of integers; a bijection (``lowbias32``)."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def _drawn(mean: Array, precision: Array, at: Array, precision_at: Array, words: Array) -> Array:
    """Return ``mean + std eps`` of cells; ``at`` are positions in the means, ``precision_at`` in the precisions."""
    read = lambda array, at: array.reshape(-1).at[at].get(mode="promise_in_bounds")
    return read(mean, at) + jax.lax.rsqrt(read(precision, precision_at)) * cell_normals(words, at)
