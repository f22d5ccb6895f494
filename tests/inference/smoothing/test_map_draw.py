"""Test draws of the map: their numbers are normal and independent, and rays see what a full sample would show."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.helpers.analytic_room import camera_pose
from tests.helpers.random_maps import ORIGIN, SHAPE, VOXEL, random_map
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.smoothing.colour_network import ColourNetwork
from vssm_gym.inference.smoothing.map_draw import MapDraw, cell_normals
from vssm_gym.maps.block_table import CELLS, BlockTable
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import march, render_with, trace, world_rays

COUNT = 1 << 17  # positions
VIEW = Camera.from_hfov(24, 18, np.radians(90))


def words(seed: int) -> jax.Array:
    return jax.random.bits(jax.random.key(seed), (2,))


def normals(key: jax.Array) -> np.ndarray:
    return np.asarray(cell_normals(key, jnp.arange(COUNT)), float)


@pytest.mark.parametrize("seed", range(3))
def test_cells_are_standard_normal(seed: int) -> None:
    eps = normals(words(seed))
    assert stats.kstest(eps, "norm").pvalue > 1e-3
    assert abs(stats.kurtosis(eps)) < 5.0 * np.sqrt(24.0 / COUNT)
    assert 4.0 < np.abs(eps).max() < 5.5
    np.testing.assert_array_equal(eps[::7], normals(words(seed))[::7])


@pytest.mark.parametrize("lag", [1, 2, 3, 8, 9, 64, 73, 512, 1024, 1536])
def test_neighbours_are_independent(lag: int) -> None:
    """In storage: along z, y, x and diagonals of a block, and between blocks; values and their squares."""
    eps = normals(words(5))
    for values in (eps, eps**2, np.abs(eps) > 2.0):
        assert abs(np.corrcoef(values[:-lag], values[lag:])[0, 1]) < 5.0 / np.sqrt(COUNT)


def test_draws_and_channels_are_independent() -> None:
    """Try other keys, and keys that differ by one bit of one word, which is the hardest for a hash."""
    key = words(6)
    others = [words(7), *(key.at[word].set(key[word] ^ jnp.uint32(1 << bit)) for word in (0, 1) for bit in (0, 13, 31))]
    eps = normals(key)
    for other in others:
        for values in (lambda x: x, lambda x: x**2):
            assert abs(np.corrcoef(values(eps), values(normals(other)))[0, 1]) < 5.0 / np.sqrt(COUNT)


def materialised(draw: MapDraw) -> VoxelMap:
    """Return the draw with all its cells written down; a row without a block is the prior's."""
    m = draw.m
    eps = lambda key, like: cell_normals(key, jnp.arange(like.size)).reshape(like.shape)
    occupancy = m.occupancy + m.occupancy_precision**-0.5 * eps(draw.occupancy_words, m.occupancy)
    colour = m.colour + m.colour_precision[:, None] ** -0.5 * eps(draw.colour_words, m.colour)
    if m.table is not None:
        occupancy, colour = occupancy.at[0].set(m.occupancy[0]), colour.at[0].set(m.colour[0])
    return eqx.tree_at(lambda m: (m.occupancy, m.colour), m, (occupancy, colour))


def uncertain(sparse: bool) -> VoxelMap:
    """Return boxes whose cells are uncertain by 3 cm and 0.1; of the sparse map some blocks have no storage."""
    m = random_map("distance", 3)
    precisions = jnp.full_like(m.occupancy_precision, 0.03**-2), jnp.full_like(m.colour_precision, 0.1**-2)
    m = eqx.tree_at(lambda m: (m.occupancy_precision, m.colour_precision), m, precisions)
    if not sparse:
        return m
    n = m.occupancy.shape[0]
    kept = np.setdiff1d(np.arange(n), [0, n - 1])
    empty = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, slots=n + 1)
    arrays = lambda m: (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision)
    filled = [new.at[1 : 1 + len(kept)].set(old[kept]) for new, old in zip(arrays(empty), arrays(m), strict=True)]
    table = BlockTable.of(m.blocks, n + 1, kept)
    return eqx.tree_at(lambda m: (*arrays(m), m.table), empty, (*filled, table))


@pytest.mark.parametrize("sparse", [False, True])
def test_rays_see_what_a_full_sample_shows(sparse: bool) -> None:
    draw = MapDraw.of(jax.random.key(8), uncertain(sparse))
    T = jnp.asarray(camera_pose((-0.9, 0.1, 1.1), 0.2), jnp.float32)
    found = jax.jit(lambda draw: trace(march, draw, *world_rays(T, VIEW), 4.0))(draw)
    full = materialised(draw)
    expected, mean = (jax.jit(lambda m: render_with(march, m, T, VIEW, 4.0))(m) for m in (full, draw.m))
    np.testing.assert_array_equal(found.hit, expected.hit.reshape(-1))
    np.testing.assert_allclose(found.depth, expected.depth.reshape(-1), atol=1e-4)
    np.testing.assert_allclose(found.rgb, expected.rgb.reshape(-1, 3), atol=1e-4)
    hits = float(np.mean(found.hit))
    assert 0.1 < hits < 1.0
    assert np.mean(np.abs(np.asarray(found.depth - mean.depth.reshape(-1))) > 1e-3) > 0.8 * hits


def test_cells_without_storage_are_the_prior_and_have_no_slope() -> None:
    m = uncertain(sparse=True)
    corner = m.origin + 2.5 * m.voxel_size  # in the first block, which has none
    draw = lambda m: MapDraw.of(jax.random.key(9), m).occupancy_at(corner)
    assert float(draw(m)) == float(m.occupancy[0, 0])
    slope = eqx.filter_grad(draw)(m)
    assert not np.any(slope.occupancy) and not np.any(slope.occupancy_precision)
    assert m.occupancy.shape[-1] == CELLS


@pytest.mark.parametrize("sparse", [False, True])
def test_a_network_paints_points_and_cells_alike(sparse: bool) -> None:
    """Rays see its colour at their surfaces; the painted map has it at the centres of stored cells, and no others."""
    m = uncertain(sparse)
    network = ColourNetwork.grey(jax.random.key(1), m, width=16, layers=2)
    leave = 0.05 * jax.random.normal(jax.random.key(2), network.leave.shape)
    network = eqx.tree_at(lambda n: n.leave, network, leave)
    draw = MapDraw.of(jax.random.key(8), m, network)
    T = jnp.asarray(camera_pose((-0.9, 0.1, 1.1), 0.2), jnp.float32)
    found = trace(march, draw, *world_rays(T, VIEW), 4.0)
    again = trace(march, MapDraw.of(jax.random.key(8), m), *world_rays(T, VIEW), 4.0)
    np.testing.assert_array_equal(found.depth, again.depth)
    assert np.abs(np.asarray(found.rgb - again.rgb))[np.asarray(found.hit)].max() > 0.1
    painted = network.painted(m)
    centres = jnp.asarray(np.asarray(m.origin) + float(m.voxel_size) * np.array([[9, 3, 4], [12, 14, 5]]), jnp.float32)
    np.testing.assert_allclose(painted.colour_at(centres), network(centres), atol=1e-5)
    if sparse:
        np.testing.assert_array_equal(painted.colour[0], m.colour[0])
