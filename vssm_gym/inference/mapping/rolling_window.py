"""Move the map's window with the camera by whole blocks: the rolling window.

Block ``b`` of the new window is block ``b + shift`` of the old one. Cells in both windows are kept unchanged; new cells
start at the prior. This is the only place where the map forgets, and the number of forgotten blocks is returned.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vssm_gym.inference.mapping.map_update import CHUNK, refresh_index
from vssm_gym.maps import empty_space
from vssm_gym.maps.block_table import BLOCK, PRIOR_SLOT, BlockTable, block_number
from vssm_gym.maps.compaction import set_numbers
from vssm_gym.maps.empty_space import EmptySpace
from vssm_gym.maps.voxel_map import PRIOR_COLOUR_STD, PRIOR_OCCUPANCY_MEAN, PRIOR_OCCUPANCY_STD, VoxelMap

_PRIOR = (PRIOR_OCCUPANCY_MEAN, PRIOR_OCCUPANCY_STD**-2, 0.0, PRIOR_COLOUR_STD**-2, 4)  # of a row, in _rows' order


def shift_to_centre(m: VoxelMap, position: Float[Array, "3"], margin: float | Float[Array, ""]) -> Int[Array, "3"]:
    """Return the shift (blocks) that brings a position (m, world) to within half a block of the window's middle.

    It is 0 while no coordinate is farther than ``margin`` metres from the middle, so that the window moves rarely.
    """
    middle = m.origin + 0.5 * m.voxel_size * (jnp.asarray(m.shape) - 1.0)
    off = position - middle
    blocks = jnp.round(off / (BLOCK * m.voxel_size)).astype(jnp.int32)
    return jnp.where(jnp.any(jnp.abs(off) > margin), blocks, 0)


def followed(m: VoxelMap, position: Float[Array, "3"], margin: float | None) -> tuple[VoxelMap, int]:
    """Move the map's window after a camera.

    Args:
        m: the map, consumed.
        position: of the camera, m, world.
        margin: distance from the window's middle from which on it moves, as a share of its edge; None: it never moves.

    Returns:
        The map, and how many observed blocks fell out of it.
    """
    if margin is None:
        return m, 0
    shift = _shift(m, position, margin * min(m.shape) * m.voxel_size)
    if not shift.any():
        return m, 0
    m, fell = move(m, shift)
    return m, int(fell)


def _rows(m: VoxelMap) -> tuple[Array, ...]:
    return m.occupancy, m.occupancy_precision, m.colour, m.colour_precision, m.empty.level


@partial(jax.jit, donate_argnums=0)
def move(m: VoxelMap, shift_blocks: Int[Array, "3"]) -> tuple[VoxelMap, Int[Array, ""]]:
    """Move the map's window by whole blocks; return the map and the number of dropped blocks with an observed cell.

    Args:
        m: Map belief; donated.
        shift_blocks: ``(3,)`` along x, y, z; positive moves the window towards larger coordinates.
    """
    n = m.blocks[0] * m.blocks[1] * m.blocks[2]
    grid = jnp.meshgrid(*(jnp.arange(b) for b in m.blocks), indexing="ij")
    before = [g + shift_blocks[a] for a, g in enumerate(grid)]  # the old coordinates of the new blocks
    kept, leaving = jnp.ones(m.blocks, bool), jnp.zeros(m.blocks, bool)
    edge = jnp.zeros(m.blocks, bool)
    for g, b, count, s in zip(grid, before, m.blocks, shift_blocks, strict=True):
        kept &= (b >= 0) & (b < count)
        leaving |= (g - s < 0) | (g - s >= count)
        # Cubes of these reach into a next block that left or entered; blocks that entered are at the prior.
        edge |= (s != 0) & ((g == count - 1) | (b == -1))
    source = jnp.where(kept, block_number(before, m.blocks), n).reshape(-1)
    rings = m.empty.rings.reshape(-1).at[source].get(mode="fill", fill_value=empty_space.MAX_RINGS).reshape(m.blocks)
    table = m.table
    if table is None:
        observed = jnp.any(m.occupancy_precision > jnp.float32(PRIOR_OCCUPANCY_STD**-2), axis=-1).reshape(m.blocks)
        dropped = jnp.sum(leaving & observed, dtype=jnp.int32)
        moved = [a.at[source].get(mode="fill", fill_value=v) for a, v in zip(_rows(m), _PRIOR, strict=True)]
    else:
        moved, table, dropped = _release(m, table, source, leaving)
        near = table.slot != PRIOR_SLOT
        for axis in range(3):  # only blocks with stored cells, and their neighbours, can have a surface
            following = jnp.pad(near, [(0, int(a == axis)) for a in range(3)])
            near = near | jax.lax.slice_in_dim(following, 1, m.blocks[axis] + 1, axis=axis)
        rings = jnp.where(edge & ~near, empty_space.MAX_RINGS, rings)  # their surface was in a block that left
        edge &= near
    occupancy, occupancy_precision, colour, colour_precision, level = moved
    empty = refresh_index(EmptySpace(level, rings), occupancy, edge.reshape(-1), table)
    origin = m.origin + shift_blocks * (BLOCK * m.voxel_size)
    m = VoxelMap(occupancy, occupancy_precision, colour, colour_precision, empty, origin, m.voxel_size, m.blocks, table)
    return m, dropped


def _release(m: VoxelMap, table: BlockTable, source: Array, leaving: Array) -> tuple[list[Array], BlockTable, Array]:
    """Move the table instead of the rows, and reset and free the slots of blocks that leave."""
    slots = table.free.shape[0]
    flat = table.slot.reshape(-1)
    ids, count = set_numbers((leaving.reshape(-1)) & (flat != PRIOR_SLOT))
    of_ids = flat.at[ids].get(mode="fill", fill_value=slots)

    def clear(i, held):
        slot = jax.lax.dynamic_slice(of_ids, (i * CHUNK,), (CHUNK,))
        return [a.at[slot].set(jnp.asarray(v, a.dtype), mode="drop") for a, v in zip(held, _PRIOR, strict=True)]

    held = jax.lax.fori_loop(0, (count + CHUNK - 1) // CHUNK, clear, list(_rows(m)))
    slot = flat.at[source].get(mode="fill", fill_value=PRIOR_SLOT)
    taken = jnp.zeros(slots, bool).at[slot].set(True).at[PRIOR_SLOT].set(True)
    free = jnp.argsort(~taken, stable=True).astype(jnp.int32)  # those taken first
    return held, BlockTable(slot.reshape(m.blocks), free, table.used - count, table.refused), count


_shift = jax.jit(shift_to_centre)
