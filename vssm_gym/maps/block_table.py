"""Store a voxel grid in blocks of 8^3 cells, one row of storage each: all blocks, or only those listed in a table.

A *dense* grid has a row for every block: ``row = (bx * by_count + by) * bz_count + bz``. A *sparse* grid has a fixed
number of rows and a table from blocks to rows (*slots*). Slot 0 is never written: it holds the prior and represents
every block without a slot of its own, so that queries need no branch.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

BLOCK = 8  # cells along one edge of a block
CELLS = BLOCK**3  # cells of a block
PRIOR_SLOT = 0  # of blocks that nobody observed: they share one, which holds the prior

Blocks = tuple[int, ...]  # blocks along x, y, z
Coordinates = Sequence[Array]  # x, y, z, one array each: operations over an axis of three do not vectorise


class BlockTable(eqx.Module):
    """Map the blocks of a grid to slots. ``free`` is a permutation of the slots, of which the first ``used`` are taken.

    ``free`` is a permutation of the slots, of which the first ``used`` are taken.
    """

    slot: Int[Array, "bx by bz"]  # PRIOR_SLOT: none of its own
    free: Int[Array, "slots"]
    used: Int[Array, ""]  # slots taken, that of the prior included
    refused: Int[Array, ""]  # number of times that a block was not updated because no slot was free

    @classmethod
    def empty(cls, blocks: Blocks, slots: int) -> "BlockTable":
        """Return a table without stored blocks."""
        one, none = jnp.asarray(1, jnp.int32), jnp.asarray(0, jnp.int32)
        return cls(jnp.zeros(blocks, jnp.int32), jnp.arange(slots, dtype=jnp.int32), one, none)

    @classmethod
    def of(cls, blocks: Blocks, slots: int, stored: np.ndarray) -> "BlockTable":
        """Return a table that stores block number ``stored[i]`` in slot ``i + 1``."""
        table = cls.empty(blocks, slots)
        slot = table.slot.reshape(-1).at[stored].set(1 + jnp.arange(len(stored), dtype=jnp.int32))
        return cls(slot.reshape(blocks), table.free, table.used + len(stored), table.refused)

    def allocate(
        self, block: Int[Array, "n"], wanted: Bool[Array, "n"]
    ) -> tuple["BlockTable", Int[Array, "n"], Bool[Array, "n"]]:
        """Find slots for the ``wanted`` ones among distinct blocks; allocate new slots where they have none.

        Returns:
            The table, which counts refused blocks; the slots (past the last slot where a block is not wanted or no
            slot is left); and which blocks are new.
        """
        slots, blocks = self.free.shape[0], self.slot.size
        have = self.rows(jnp.minimum(block, blocks - 1))
        lacking = wanted & (have == PRIOR_SLOT)
        place = self.used + jnp.cumsum(lacking, dtype=jnp.int32) - 1
        new = lacking & (place < slots)
        given = self.free.at[jnp.minimum(place, slots - 1)].get(mode="promise_in_bounds")
        slot = self.slot.reshape(-1).at[jnp.where(new, block, blocks)].set(given, mode="drop")
        table = BlockTable(
            slot.reshape(self.slot.shape),
            self.free,
            self.used + jnp.sum(new, dtype=jnp.int32),
            self.refused + jnp.sum(lacking & ~new, dtype=jnp.int32),
        )
        return table, jnp.where(new, given, jnp.where(wanted & ~lacking, have, slots)), new

    def rows(self, block: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
        """Return the slots of block numbers."""
        return self.slot.reshape(-1).at[block].get(mode="promise_in_bounds")


def rows(block: Int[Array, "*batch"], table: BlockTable | None) -> Int[Array, "*batch"]:
    """Return the storage rows of block numbers."""
    return block if table is None else table.rows(block)


def stored_rows(count: int, table: BlockTable | None) -> Bool[Array, "count"]:
    """Return which of so many storage rows hold a block of their own."""
    if table is None:
        return jnp.ones(count, bool)
    return jnp.zeros(count, bool).at[table.slot.reshape(-1)].set(True).at[PRIOR_SLOT].set(False)


def block_number(b: Coordinates, blocks: Blocks) -> Array:
    """Return the number of the block at block coordinates ``b``; z runs fastest."""
    return (b[0] * blocks[1] + b[1]) * blocks[2] + b[2]


def block_coordinates(block: Int[Array, "*batch"], blocks: Blocks) -> tuple[Array, Array, Array]:
    """Return the coordinates ``bx, by, bz`` of block numbers."""
    by, bz = blocks[1], blocks[2]
    return block // (by * bz), (block // bz) % by, block % bz


def cell_offset(cell: Coordinates, blocks: Blocks, table: BlockTable | None) -> Array:
    """Return the position of cell ``(i, j, k)`` in block storage read as one flat array."""
    row = rows(block_number([c >> 3 for c in cell], blocks), table)
    i, j, k = (c & (BLOCK - 1) for c in cell)
    return row * CELLS + (i * BLOCK + j) * BLOCK + k


def corner_offsets(cell: Coordinates, blocks: Blocks, table: BlockTable | None) -> list[Array]:
    """Return the flat positions of the eight cells ``(i..i+1, j..j+1, k..k+1)``, x slowest, z fastest."""
    block_strides, cell_strides = (blocks[1] * blocks[2], blocks[2], 1), (BLOCK * BLOCK, BLOCK, 1)

    def parts(c, axis):  # a coordinate's contributions to the block number and to the position in the block
        return (c >> 3) * block_strides[axis], (c & (BLOCK - 1)) * cell_strides[axis]

    x, y, z = ([parts(c, axis), parts(c + 1, axis)] for axis, c in enumerate(cell))
    return [rows(a[0] + b[0] + c[0], table) * CELLS + (a[1] + b[1] + c[1]) for a in x for b in y for c in z]
