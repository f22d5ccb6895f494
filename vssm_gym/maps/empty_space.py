"""Index certified empty boxes of a voxel grid, which rays may skip; updated block by block.

The field is the trilinear interpolation of its cells, hence a convex combination of the eight around a point: where all
eight are at or below the threshold there is no surface between them. A *cube* is the region between eight neighbouring
cells, named by its lowest one; it is *occupied* when any of the eight exceeds the threshold. For every cube the index
stores the size of the largest aligned empty box (1, 2, 4 or 8 cubes wide) around it inside its 8^3 block, and for every
block how many rings of blocks around it are empty. A projective, truncated distance (PRISM's map update) does not bound
the distance to the surface. These boxes do: a search that skips them misses no hit of the fixed march.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from vssm_gym.maps.block_table import BLOCK, CELLS, PRIOR_SLOT, Blocks, BlockTable, block_coordinates, cell_offset

MAX_RINGS = 12  # rings of empty blocks that are counted; a ray reads the index again after 12 blocks

_EDGE = np.arange(BLOCK + 1)  # the cells along an edge of a block, and the next
# The 9^3 cells that a block's cubes use
_WINDOW = np.stack(np.meshgrid(_EDGE, _EDGE, _EDGE, indexing="ij"), -1).reshape(-1, 3)


class EmptySpace(eqx.Module):
    """Hold certified empty boxes. ``level`` 0: occupied cube; 1, 2, 3, 4: in an empty aligned box of 1, 2, 4, 8 cubes.

    A sparse grid has no levels for blocks without storage. Such a block need not be empty, because its last cubes use
    cells of the next blocks; therefore the prior's row has level 0 (must be searched) everywhere.
    """

    level: UInt8[Array, "rows cells"]
    rings: UInt8[Array, "bx by bz"]  # 0: the block has an occupied cube; r: every block nearer than r rings is empty

    @classmethod
    def of_prior(cls, rows: int, blocks: Blocks, sparse: bool) -> "EmptySpace":
        """Return the index of a map without surfaces."""
        level = jnp.full((rows, CELLS), 4, jnp.uint8)
        level = level.at[PRIOR_SLOT].set(0) if sparse else level
        return cls(level, jnp.full(blocks, MAX_RINGS, jnp.uint8))


def block_levels(
    occupancy: Float[Array, "rows cells"],
    ids: Int[Array, "n"],
    blocks: Blocks,
    threshold: float,
    table: BlockTable | None = None,
) -> UInt8[Array, "n cells"]:
    """Compute ``level`` rows of the blocks ``ids``, read from their cells and the first layer of the next blocks."""
    # Cubes past the last cell repeat it: there is nothing beyond the grid.
    cells = [
        jnp.minimum(b[:, None] * BLOCK + _WINDOW[:, a], blocks[a] * BLOCK - 1)
        for a, b in enumerate(block_coordinates(ids, blocks))
    ]
    flat = cell_offset(cells, blocks, table)
    above = occupancy.reshape(-1).at[flat].get(mode="promise_in_bounds") > threshold
    # Nine cells along z as nine bits: each operation below handles a whole row of cubes.
    bits = jnp.sum(above.reshape(-1, BLOCK + 1, BLOCK + 1, BLOCK + 1).astype(jnp.int32) << _EDGE, axis=-1)
    bits = bits | (bits >> 1)
    bits = bits[:, :-1] | bits[:, 1:]
    bits = (bits[:, :, :-1] | bits[:, :, 1:]) & 0xFF
    z = np.arange(BLOCK)
    level = jnp.zeros((ids.shape[0], BLOCK, BLOCK, BLOCK), jnp.int32)
    for size in (1, 2, 4, 8):
        if size > 1:
            bits = bits[:, 0::2] | bits[:, 1::2]
            bits = bits[:, :, 0::2] | bits[:, :, 1::2]
            bits = bits | (bits >> (size // 2))  # a box's bit is that of its lower half
        boxes = jnp.repeat(jnp.repeat(bits, size, axis=1), size, axis=2)
        level = level + (1 - ((boxes[..., None] >> (z // size * size)) & 1))
    return level.astype(jnp.uint8).reshape(-1, CELLS)


def empty_rings(occupied: Bool[Array, "bx by bz"]) -> UInt8[Array, "bx by bz"]:
    """Return the Chebyshev distance, in blocks, to the nearest occupied block, at most ``MAX_RINGS``."""
    bx, by, bz = occupied.shape
    words = -(-bz // 32)
    bit = np.arange(32, dtype=np.uint32)
    padded = jnp.pad(occupied, ((0, 0), (0, 0), (0, 32 * words - bz))).reshape(bx, by, words, 32)
    reached = jnp.sum(padded.astype(jnp.uint32) << bit, axis=-1, dtype=jnp.uint32)

    def ring(_, carry):
        reached, planes = carry
        counted, add = [], ~reached  # one more ring where not reached: addition on bit planes, a block a bit
        for plane in planes:
            counted.append(plane ^ add)
            add = plane & add
        edge = jnp.pad(reached, ((1, 1), (1, 1), (1, 1)))
        carried = jnp.roll(edge >> 31, 1, axis=2) | jnp.roll(edge << 31, -1, axis=2)
        along_z = (edge | (edge << 1) | (edge >> 1) | carried)[:, :, 1:-1]
        along_y = along_z[:, :-2] | along_z[:, 1:-1] | along_z[:, 2:]
        return along_y[:-2] | along_y[1:-1] | along_y[2:], counted

    planes = [jnp.zeros_like(reached)] * MAX_RINGS.bit_length()
    _, planes = jax.lax.fori_loop(0, MAX_RINGS, ring, (reached, planes))
    rings = sum(((plane[..., None] >> bit) & 1) << p for p, plane in enumerate(planes))
    return rings.astype(jnp.uint8).reshape(bx, by, -1)[:, :, :bz]


def build(
    occupancy: Float[Array, "rows cells"], blocks: Blocks, table: BlockTable | None = None, threshold: float = 0.0
) -> EmptySpace:
    """Build the index of a whole grid, in chunks, so that the 9^3 windows are never all in memory together."""
    n, rows = blocks[0] * blocks[1] * blocks[2], occupancy.shape[0]
    chunk = min(n, 256)

    def one_chunk(i, carry):
        level, occupied = carry
        block = jnp.minimum(i * chunk + jnp.arange(chunk), n - 1)  # the last chunk repeats the last block
        found = block_levels(occupancy, block, blocks, threshold, table)
        row = block
        if table is not None:
            row = jnp.where(table.rows(block) == PRIOR_SLOT, rows, table.rows(block))
        return level.at[row].set(found, mode="drop"), occupied.at[block].set(found[:, 0] < 4)

    start = EmptySpace.of_prior(rows, blocks, table is not None)
    level, occupied = jax.lax.fori_loop(0, -(-n // chunk), one_chunk, (start.level, jnp.zeros(n, bool)))
    return EmptySpace(level, empty_rings(occupied.reshape(blocks)))
