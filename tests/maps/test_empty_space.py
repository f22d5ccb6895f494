"""Test the empty-space index against brute force over the dense grid: exact, and no box missed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_cdt

from tests.helpers.random_maps import KINDS, kinds, random_map, seeds
from vssm_gym.maps.block_table import BLOCK, block_coordinates, block_number, cell_offset, corner_offsets
from vssm_gym.maps.empty_space import MAX_RINGS, empty_rings
from vssm_gym.maps.voxel_map import VoxelMap


def occupied_cubes(m: VoxelMap) -> np.ndarray:
    """Return (nx, ny, nz): any of the eight cells from (i, j, k) on is above zero.

    Cells beyond the grid repeat its last.
    """
    above = np.pad(np.asarray(m.dense(m.occupancy)) > 0.0, (0, 1), mode="edge")
    cubes = np.zeros(m.shape, bool)
    for i, j, k in np.ndindex(2, 2, 2):
        cubes |= above[i : i + m.shape[0], j : j + m.shape[1], k : k + m.shape[2]]
    return cubes


def levels_by_definition(m: VoxelMap) -> np.ndarray:
    """Return the number of nested aligned boxes of 1, 2, 4, 8 cubes around a cube that are wholly empty."""
    occupied = occupied_cubes(m)
    level = np.zeros(m.shape, int)
    for size in (1, 2, 4, 8):
        boxes = occupied.reshape(m.shape[0] // size, size, m.shape[1] // size, size, m.shape[2] // size, size).any(
            axis=(1, 3, 5)
        )
        level += ~np.kron(boxes, np.ones((size, size, size), bool))
    return level


@given(kinds, seeds)
def test_levels_are_the_largest_empty_aligned_boxes(kind: str, seed: int) -> None:
    m = random_map(kind, seed)
    np.testing.assert_array_equal(np.asarray(m.dense(m.empty.level)), levels_by_definition(m))


@given(kinds, seeds)
def test_rings_are_the_chessboard_distance_to_an_occupied_block(kind: str, seed: int) -> None:
    m = random_map(kind, seed)
    bx, by, bz = m.blocks
    occupied = occupied_cubes(m).reshape(bx, BLOCK, by, BLOCK, bz, BLOCK).any(axis=(1, 3, 5))
    expected = np.full(m.blocks, MAX_RINGS)
    if occupied.any():
        expected = np.minimum(distance_transform_cdt(~occupied, metric="chessboard"), MAX_RINGS)
    np.testing.assert_array_equal(np.asarray(m.empty.rings), expected)


def test_rings_stop_counting() -> None:
    """A row of 16 blocks with one occupied cell at its end: 0, 1, 2, ... and no more than MAX_RINGS."""
    m = VoxelMap.prior((0.0, 0.0, 0.0), 0.1, (16 * BLOCK, BLOCK, BLOCK))
    m = m.with_occupancy(m.occupancy.at[0, 0].set(1.0))
    np.testing.assert_array_equal(np.asarray(m.empty.rings).ravel(), np.minimum(np.arange(16), MAX_RINGS))


@given(seeds, st.sampled_from([(3, 4, 5), (1, 2, 70), (5, 1, 33), (2, 3, 32)]))
def test_rings_of_any_grid(seed: int, blocks: tuple[int, int, int]) -> None:
    """Blocks along z are handled as bits of words of 32: grids that fill one, end within one, and need several."""
    rng = np.random.default_rng(seed)
    occupied = rng.uniform(size=blocks) < rng.choice([0.01, 0.1])
    occupied.flat[rng.integers(occupied.size)] = True
    expected = np.minimum(distance_transform_cdt(~occupied, metric="chessboard"), MAX_RINGS)
    np.testing.assert_array_equal(np.asarray(rings_of(jnp.asarray(occupied))), expected)


rings_of = jax.jit(empty_rings)


@pytest.mark.parametrize("kind", KINDS)
def test_the_threshold_itself_is_empty(kind: str) -> None:
    """Occupied means strictly above: a field shifted so that its largest cell is exactly 0 has no surface."""
    m = random_map(kind, 5)
    m = m.with_occupancy(m.occupancy - m.occupancy.max())
    assert int(m.empty.level.min()) == 4
    assert int(m.empty.rings.min()) == MAX_RINGS


def test_flat_positions_agree_with_the_dense_layout() -> None:
    m = VoxelMap.prior((0.0, 0.0, 0.0), 0.1, (16, 24, 8))
    flat = jnp.arange(m.occupancy.size).reshape(m.occupancy.shape)
    i, j, k = jnp.asarray(np.indices(m.shape))
    np.testing.assert_array_equal(cell_offset([i, j, k], m.blocks, None), np.asarray(m.dense(flat)))
    corners = corner_offsets([c[:-1, :-1, :-1] for c in (i, j, k)], m.blocks, None)
    dense = np.asarray(m.dense(flat))
    expected = [dense[a : a + 15, b : b + 23, c : c + 7] for a, b, c in np.ndindex(2, 2, 2)]
    np.testing.assert_array_equal(np.stack(corners), np.stack(expected))


def test_block_numbers_run_fastest_along_z() -> None:
    blocks = (2, 3, 4)
    numbers = np.arange(24)
    bx, by, bz = block_coordinates(jnp.asarray(numbers), blocks)
    np.testing.assert_array_equal(np.stack([bx, by, bz]), np.stack(np.unravel_index(numbers, blocks)))
    np.testing.assert_array_equal(block_number([bx, by, bz], blocks), numbers)
