"""Where a ray may skip: certified empty boxes of a voxel grid, kept up to date block by block.

The field is the trilinear interpolation of its cells, hence a convex combination of the eight around a point: where all
eight are at or below the threshold there is no surface between them. A *cube* is the region between eight neighbouring
cells, named by its lowest one; it is *occupied* when any of the eight exceeds the threshold. For every cube the index
stores the size of the largest aligned empty box (1, 2, 4 or 8 cubes wide) around it inside its 8^3 block, and for every
block how many rings of blocks around it are empty. A projective, truncated distance is no bound on the distance to the
surface (SPEC 3, step 5); these boxes are, so a search that skips by them passes no hit of the fixed march.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

BLOCK = 8  # cells along one edge of a block
CELLS = BLOCK**3  # cells of a block
MAX_RINGS = 12  # rings of empty blocks that are counted; a ray re-reads the index after 12 blocks

_EDGE = np.arange(BLOCK + 1)
# The 9^3 cells that a block's cubes touch
_WINDOW = np.stack(np.meshgrid(_EDGE, _EDGE, _EDGE, indexing="ij"), -1).reshape(-1, 3)


class EmptySpace(eqx.Module):
    """Certified empty boxes. ``level`` 0: occupied cube; 1, 2, 3, 4: in an empty aligned box of 1, 2, 4, 8 cubes."""

    level: UInt8[Array, "blocks cells"]
    rings: Int[Array, "bx by bz"]  # 0: the block has an occupied cube; r: every block nearer than r rings is empty


def axis_offsets(i: Array, j: Array, k: Array, blocks: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """Three offsets whose sum is the position of cell ``(i, j, k)`` in block storage read as one flat array."""
    block_strides = (blocks[1] * blocks[2] * CELLS, blocks[2] * CELLS, CELLS)
    cell_strides = (BLOCK * BLOCK, BLOCK, 1)
    x, y, z = ((c >> 3) * block_strides[a] + (c & (BLOCK - 1)) * cell_strides[a] for a, c in enumerate((i, j, k)))
    return x, y, z


def corner_offsets(i: Array, j: Array, k: Array, blocks: tuple[int, int, int]) -> list[Array]:
    """Flat positions of the eight cells ``(i..i+1, j..j+1, k..k+1)``, x slowest, z fastest."""
    low, high = axis_offsets(i, j, k, blocks), axis_offsets(i + 1, j + 1, k + 1, blocks)
    return [x + y + z for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]


def block_coordinates(block: Int[Array, "*batch"], blocks: tuple[int, int, int]) -> Int[Array, "*batch 3"]:
    """``(bx, by, bz)`` of block numbers."""
    by, bz = blocks[1], blocks[2]
    return jnp.stack([block // (by * bz), (block // bz) % by, block % bz], axis=-1)


def block_levels(
    occupancy: Float[Array, "blocks cells"], ids: Int[Array, "n"], blocks: tuple[int, int, int], threshold: float
) -> UInt8[Array, "n cells"]:
    """``level`` rows of the blocks ``ids``, read from their cells and the first layer of the next blocks."""
    base = block_coordinates(ids, blocks) * BLOCK
    limit = jnp.asarray(blocks) * BLOCK - 1  # cubes past the last cell repeat it: there is nothing beyond the grid
    cell = jnp.minimum(base[:, None, :] + _WINDOW, limit)
    flat = sum(axis_offsets(cell[..., 0], cell[..., 1], cell[..., 2], blocks))
    window = occupancy.reshape(-1).at[flat].get(mode="promise_in_bounds") > threshold
    window = window.reshape(-1, BLOCK + 1, BLOCK + 1, BLOCK + 1)
    x = window[:, :-1] | window[:, 1:]
    y = x[:, :, :-1] | x[:, :, 1:]
    cube = y[..., :-1] | y[..., 1:]
    level = jnp.zeros(cube.shape, jnp.uint8)
    for size in (1, 2, 4, 8):
        n = BLOCK // size
        boxes = cube.reshape(-1, n, size, n, size, n, size).any(axis=(2, 4, 6))
        wide = boxes[:, :, None, :, None, :, None]
        wide = jnp.broadcast_to(wide, (boxes.shape[0], n, size, n, size, n, size)).reshape(cube.shape)
        level = level + (~wide).astype(jnp.uint8)
    return level.reshape(-1, CELLS)


def empty_rings(level: UInt8[Array, "blocks cells"], blocks: tuple[int, int, int]) -> Int[Array, "bx by bz"]:
    """Chebyshev distance, in blocks, to the nearest block with an occupied cube; capped at ``MAX_RINGS``."""
    occupied = (level[:, 0] < 4).reshape(blocks)  # an empty block has level 4 in every cube, so one cube tells
    rings = jnp.where(occupied, 0, MAX_RINGS).astype(jnp.int32)
    reached = occupied
    for r in range(1, MAX_RINGS):
        for axis in range(3):
            pad = [(1, 1) if a == axis else (0, 0) for a in range(3)]
            padded = jnp.pad(reached, pad)
            n = reached.shape[axis]
            low = jax.lax.slice_in_dim(padded, 0, n, axis=axis)
            high = jax.lax.slice_in_dim(padded, 2, n + 2, axis=axis)
            reached = reached | low | high
        rings = jnp.where(reached & (rings == MAX_RINGS), r, rings)
    return rings


def build(occupancy: Float[Array, "blocks cells"], blocks: tuple[int, int, int], threshold: float = 0.0) -> EmptySpace:
    """The index of a whole grid, in chunks so that the 9^3 windows never stand in memory together."""
    ids = jnp.arange(occupancy.shape[0], dtype=jnp.int32)
    level = jax.lax.map(lambda i: block_levels(occupancy, i[None], blocks, threshold)[0], ids, batch_size=256)
    return EmptySpace(level, empty_rings(level, blocks))
