"""Find where the cells of a map are, by their places in its storage."""

import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.maps.block_table import BLOCK, CELLS, PRIOR_SLOT
from vssm_gym.maps.voxel_map import VoxelMap


def cell_centres(m: VoxelMap, chosen: Bool[np.ndarray, "rows cells"]) -> Float[np.ndarray, "n 3"]:
    """Return the centres (m, map frame) of chosen cells, in the order of the storage.

    Args:
        m: dense or block-sparse.
        chosen: by storage row, as its arrays have it: the whole cube of a sparse map may not fit into memory.
    """
    row, cell = np.nonzero(chosen)
    block = np.arange(len(chosen))
    if m.table is not None:
        slot = np.asarray(m.table.slot).reshape(-1)
        stored = np.flatnonzero(slot != PRIOR_SLOT)
        block[slot[stored]] = stored
    corner = np.stack(np.unravel_index(block[row], m.blocks), axis=-1) * BLOCK
    within = np.stack(np.unravel_index(np.arange(CELLS), (BLOCK,) * 3), axis=-1)[cell]
    return np.asarray(m.origin, float) + (corner + within) * float(m.voxel_size)
