"""``q_t(M) ∝ q_t-1(M) q(M | x_t, z_t)``: the closed-form map update (PRISM, step 5).

A posed depth image is a Gaussian observation of every cell between the camera and a band behind the surface
(:mod:`vssm_gym.inference.mapping.observation`). Precisions add and the mean is the precision-weighted average: the
update of Curless and Levoy (1996) as Bayesian inference.

Cells are updated in whole blocks. Blocks in view are listed (:mod:`vssm_gym.inference.mapping.visible_blocks`) and
processed in chunks by a loop with a dynamic trip count, so that the cost depends on what is in view only.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.mapping.observation import MapUpdateConfig, Pixels, expectation, observe_cells
from vssm_gym.inference.mapping.visible_blocks import blocks_in_view
from vssm_gym.maps import empty_space
from vssm_gym.maps.block_table import BLOCK, PRIOR_SLOT, Blocks, BlockTable, block_coordinates, block_number, rows
from vssm_gym.maps.compaction import set_numbers
from vssm_gym.maps.empty_space import EmptySpace
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import TAU

DEFAULT = MapUpdateConfig()
CHUNK = 64  # blocks a loop iteration: wide enough to vectorise, narrow enough to waste little on the last one

_INNER = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)  # cells of a block
_BEFORE = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), -1).reshape(-1, 3)


def fuse(mean: Array, precision: Array, observed: Array, weight: Array) -> tuple[Array, Array]:
    """``N(mean, 1/precision) N(observed, 1/weight)``: mean and precision of the product; weight 0 changes nothing."""
    total = precision + weight
    return mean + weight / total * (observed - mean), total


def _revise(
    m: VoxelMap, depth: Array, rgb: Array, T_world_cam: Array, camera: Camera, config: MapUpdateConfig
) -> VoxelMap:
    """Return the map after one image, in expectation over the poses ``(samples, 4, 4)``."""
    pixels = Pixels.of(depth, rgb, config.max_depth)
    depth = pixels.depth[:-1].reshape(depth.shape)
    T_cam_world = inverse(T_world_cam)
    blocks, slots = m.blocks[0] * m.blocks[1] * m.blocks[2], m.occupancy.shape[0]
    ids, count = blocks_in_view(m, depth, T_cam_world, camera, config)

    def revise(i, carry):
        (occupancy, occupancy_precision, colour, colour_precision), table, dirty = carry
        block = jax.lax.dynamic_slice(ids, (i * CHUNK,), (CHUNK,))
        known = jnp.minimum(block, blocks - 1)
        corner = block_coordinates(known, m.blocks)

        def observe(T):
            # p_cam of a cell is its block's first corner plus its offset in the block, each rotated once.
            R, t = T[:3, :3], T[:3, 3]
            first = [c * BLOCK * m.voxel_size + m.origin[a] for a, c in enumerate(corner)]
            p = [
                (R[a, 0] * first[0] + R[a, 1] * first[1] + R[a, 2] * first[2] + t[a])[:, None]
                + (R[a, 0] * _INNER[:, 0] + R[a, 1] * _INNER[:, 1] + R[a, 2] * _INNER[:, 2]) * m.voxel_size
                for a in range(3)
            ]
            return observe_cells((p[0], p[1], p[2]), m.voxel_size, pixels, camera, config)

        o = expectation(observe, T_cam_world)
        old = rows(known, table)
        before = occupancy[old]
        new_o, new_po = fuse(before, occupancy_precision[old], o.occupancy, o.weight)
        new_c, _ = fuse(colour[old], colour_precision[old][:, None], o.colour, o.colour_weight[:, None])
        new_pc = colour_precision[old] + o.colour_weight
        changed = jnp.any((before > TAU) != (new_o > TAU), axis=-1) & (block < blocks)
        if table is None:
            row = block  # past the last: dropped
        else:
            observed = jnp.any(o.weight > 0.0, axis=-1) & (block < blocks)
            table, row, new = table.allocate(block, observed)
            # The row of a new block is "empty" until the index is refreshed; it may lie beside a surface.
            changed = (changed & (row < slots)) | (new & (m.empty.rings.reshape(-1)[known] == 0))
        belief = (
            occupancy.at[row].set(new_o, mode="drop"),
            occupancy_precision.at[row].set(new_po, mode="drop"),
            colour.at[row].set(new_c, mode="drop"),
            colour_precision.at[row].set(new_pc, mode="drop"),
        )
        return belief, table, dirty.at[_cubes_of(block, m.blocks, changed)].set(True, mode="drop")

    belief = (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision)
    turns = (count + CHUNK - 1) // CHUNK
    belief, table, dirty = jax.lax.fori_loop(0, turns, revise, (belief, m.table, jnp.zeros(blocks, bool)))
    occupancy, occupancy_precision, colour, colour_precision = belief
    empty = refresh_index(m.empty, occupancy, dirty, table)
    return VoxelMap(
        occupancy, occupancy_precision, colour, colour_precision, empty, m.origin, m.voxel_size, m.blocks, table
    )


def _cubes_of(block: Array, blocks: Blocks, changed: Array) -> Array:
    """Return numbers (n, 8) of the blocks whose cubes use cells of the ``changed`` ones; past the last for the others.

    The cubes of a block read the first layer of the next ones: it is the block itself and those before it.
    """
    b = [c[:, None] - _BEFORE[:, a] for a, c in enumerate(block_coordinates(block, blocks))]
    valid = changed[:, None] & (b[0] >= 0) & (b[1] >= 0) & (b[2] >= 0)
    return jnp.where(valid, block_number(b, blocks), blocks[0] * blocks[1] * blocks[2])


def refresh_index(
    empty: EmptySpace, occupancy: Array, dirty: Bool[Array, "blocks"], table: BlockTable | None
) -> EmptySpace:
    """Update the index after cubes of the ``dirty`` blocks may have become occupied or empty."""
    blocks, slots, n = empty.rings.shape, occupancy.shape[0], dirty.shape[0]
    ids, count = set_numbers(dirty)

    def relevel(i, carry):
        level, occupied = carry
        block = jax.lax.dynamic_slice(ids, (i * CHUNK,), (CHUNK,))
        found = empty_space.block_levels(occupancy, jnp.minimum(block, n - 1), blocks, TAU, table)
        row = block
        if table is not None:
            slot = table.rows(jnp.minimum(block, n - 1))
            row = jnp.where((block < n) & (slot != PRIOR_SLOT), slot, slots)
        return level.at[row].set(found, mode="drop"), occupied.at[block].set(found[:, 0] < 4, mode="drop")

    start = (empty.level, empty.rings.reshape(-1) == 0)
    level, occupied = jax.lax.fori_loop(0, (count + CHUNK - 1) // CHUNK, relevel, start)
    return EmptySpace(level, empty_space.empty_rings(occupied.reshape(blocks)))


@partial(jax.jit, static_argnums=5, donate_argnums=0)
def update(
    m: VoxelMap,
    depth: Float[Array, "height width"],
    rgb: Float[Array, "height width 3"],
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    config: MapUpdateConfig = DEFAULT,
) -> VoxelMap:
    """``q(M) q(M | x, z)``: the map after one posed image. The map passed in is consumed (its buffers are reused).

    A block-sparse map gets storage for the blocks in which a cell was observed; where no slot is left the block stays
    as it was and is counted in ``m.table.refused``.

    Args:
        m: Map belief; donated.
        depth: ``(height, width)`` z-depth, m; 0 = no reading.
        rgb: ``(height, width, 3)`` in [0, 1].
        T_world_cam: ``(4, 4)`` camera pose.
        camera: Intrinsics.
        config: Truncation, std and range.

    Returns:
        The map belief, its empty-space index following the new means.
    """
    return _revise(m, depth, rgb, T_world_cam[None], camera, config)


@partial(jax.jit, static_argnums=5, donate_argnums=0)
def update_expected(
    m: VoxelMap,
    depth: Float[Array, "height width"],
    rgb: Float[Array, "height width 3"],
    T_samples: Float[Array, "samples 4 4"],
    camera: Camera,
    config: MapUpdateConfig = DEFAULT,
) -> VoxelMap:
    """``q(M) E_q(z)[q(M | x, z)]``: :func:`update` in expectation over pose samples (see :func:`expectation`; eq. I21).

    Args:
        m: Map belief; donated.
        depth: ``(height, width)`` z-depth, m; 0 = no reading.
        rgb: ``(height, width, 3)`` in [0, 1].
        T_samples: ``(samples, 4, 4)`` camera poses, equally likely.
        camera: Intrinsics.
        config: Truncation, std and range.

    Returns:
        The map belief; with one sample that of :func:`update`.
    """
    return _revise(m, depth, rgb, T_samples, camera, config)
