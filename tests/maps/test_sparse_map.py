"""Test the block-sparse map against the dense one, cell for cell, and the rolling window of both."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.random_maps import seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.inference.mapping.rolling_window import move, shift_to_centre
from vssm_gym.maps import empty_space
from vssm_gym.maps.block_table import BLOCK, PRIOR_SLOT, BlockTable
from vssm_gym.maps.compaction import first_set, set_numbers
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_MEAN, VoxelMap, read_metadata
from vssm_gym.model.emission import march, render, search
from vssm_gym.viz.mesh import surface_mesh

VOXEL, SHAPE, ORIGIN = 0.1, (48, 40, 72), (-2.4, -2.0, -3.6)  # 6 x 5 x 9 blocks
SLOTS = 200  # more than the camera ever sees
ROOM = Room(interior=((-2.0, -1.3, -1.2), (1.9, 1.6, 1.7)), boxes=(((0.3, 0.2, -1.2), (0.9, 0.8, 0.1)),))
CAMERA = Camera.from_hfov(32, 24, np.radians(75))
ARRAYS = ("occupancy", "occupancy_precision", "colour", "colour_precision")


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def copy(m: VoxelMap) -> VoxelMap:
    return jax.tree.map(jnp.copy, m)


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 7])
    return camera_pose(tuple(rng.uniform((-1.5, -1.0, -0.8), (0.0, 1.2, 1.2))), *rng.uniform(-3.0, 3.0, 3))


def seen(seed: int, images: int, slots: int | None) -> VoxelMap:
    """Return a map of the room after some images."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, slots)
    for i in range(images):
        T = np.asarray(f32(pose(seed + i)), float)
        image = ROOM.image(T, CAMERA)
        m = update(m, image.depth, image.rgb, f32(T), CAMERA)
    return m


def assert_same_belief(a: VoxelMap, b: VoxelMap) -> None:
    for name in ARRAYS:
        x, y = (np.asarray(m.dense(getattr(m, name))) for m in (a, b))
        np.testing.assert_allclose(x, y, atol=1e-6, err_msg=name)


def assert_sound(m: VoxelMap) -> None:
    """Assert that slots are distinct and counted, free rows are at the prior, and the index is that of the means."""
    slot, free, used = np.asarray(m.table.slot), np.asarray(m.table.free), int(m.table.used)
    taken = slot[slot != PRIOR_SLOT]
    assert sorted(free) == list(range(len(free)))
    assert sorted([PRIOR_SLOT, *taken]) == sorted(free[:used])
    untouched = np.setdiff1d(np.arange(len(free)), taken)
    np.testing.assert_array_equal(np.asarray(m.occupancy)[untouched], np.float32(PRIOR_OCCUPANCY_MEAN))
    np.testing.assert_array_equal(np.asarray(m.occupancy_precision)[untouched], np.float32(0.01))
    np.testing.assert_array_equal(np.asarray(m.colour)[untouched], 0.0)
    np.testing.assert_array_equal(np.asarray(m.colour_precision)[untouched], np.float32(0.01))
    fresh = build(m.occupancy, m.table)
    np.testing.assert_array_equal(np.asarray(m.empty.rings), np.asarray(fresh.rings))
    np.testing.assert_array_equal(np.asarray(m.empty.level), np.asarray(fresh.level))


build = jax.jit(lambda occupancy, table: empty_space.build(occupancy, (6, 5, 9), table))
search_jit, march_jit = jax.jit(search), jax.jit(march)


@pytest.mark.slow
@given(seeds, st.integers(1, 4))
def test_sparse_and_dense_updates_agree(seed: int, images: int) -> None:
    dense, sparse = seen(seed, images, None), seen(seed, images, SLOTS)
    assert_same_belief(sparse, dense)
    np.testing.assert_array_equal(np.asarray(sparse.empty.rings), np.asarray(dense.empty.rings))
    assert_sound(sparse)
    assert int(sparse.table.refused) == 0
    observed = np.asarray(dense.occupancy_precision > 0.02).any(axis=1)
    np.testing.assert_array_equal(np.asarray(sparse.table.slot).ravel() != PRIOR_SLOT, observed)


@pytest.mark.slow
@given(seeds)
def test_sparse_and_dense_images_agree(seed: int) -> None:
    """Also from outside the room, where rays cross blocks that nothing is stored for."""
    dense, sparse = seen(seed, 3, None), seen(seed, 3, SLOTS)
    for T in (pose(seed), pose(seed + 1), camera_pose((-2.3, -1.9, 3.0), 0.7, 0.5)):
        a, b = (render(m, f32(T), CAMERA) for m in (dense, sparse))
        np.testing.assert_array_equal(np.asarray(a.hit), np.asarray(b.hit))
        np.testing.assert_array_equal(np.asarray(a.known), np.asarray(b.known))
        np.testing.assert_allclose(np.asarray(a.depth), np.asarray(b.depth), atol=1e-5)
        np.testing.assert_allclose(np.asarray(a.rgb), np.asarray(b.rgb), atol=5e-5)  # both are compiled differently


@given(seeds)
def test_search_is_march_on_a_sparse_map(seed: int) -> None:
    """Rays from anywhere, through stored blocks and others."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-2.3, 2.3, 3)
    directions = rng.standard_normal((256, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    m = seen(seed, 2, SLOTS)
    (k, hit), (k_march, hit_march) = (f(m, f32(centre), f32(directions)) for f in (search_jit, march_jit))
    same = (np.asarray(hit) == np.asarray(hit_march)) & (~np.asarray(hit) | (np.asarray(k) == np.asarray(k_march)))
    assert same.mean() > 0.98  # a sample on the threshold may fall on either side


def test_a_surface_that_begins_in_a_block_without_storage_is_found() -> None:
    """One solid block alone is stored. The field rises from the prior to it in the last cubes of the block before."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, 3)
    solid = np.ravel_multi_index((3, 2, 4), m.blocks)
    table = BlockTable.of(m.blocks, 3, np.array([solid]))
    m = eqx.tree_at(lambda m: m.table, m, table).with_occupancy(m.occupancy.at[1].set(0.2))
    middle = np.array(ORIGIN) + VOXEL * BLOCK * np.array([3.4, 2.4, 4.4])
    centre = middle - [2.0, 0.0, 0.0]
    towards = middle + np.random.default_rng(0).uniform(-0.3, 0.3, (256, 3)) - centre
    directions = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    (k, hit), (k_march, hit_march) = (f(m, f32(centre), f32(directions)) for f in (search_jit, march_jit))
    assert bool(hit.all())
    assert bool(hit_march.all())
    assert np.mean(np.asarray(k) == np.asarray(k_march)) > 0.98


@pytest.mark.slow
@given(seeds)
def test_queries_agree(seed: int) -> None:
    dense, sparse = seen(seed, 2, None), seen(seed, 2, SLOTS)
    p = f32(np.random.default_rng(seed).uniform(-2.6, 2.6, (64, 3)))
    for query in (VoxelMap.field, VoxelMap.precision, VoxelMap.observed_at, VoxelMap.occupancy_at):
        np.testing.assert_allclose(np.asarray(query(dense, p)), np.asarray(query(sparse, p)), atol=1e-5)


@given(seeds)
def test_sparse_precision_never_falls(seed: int) -> None:
    before, after = seen(seed, 1, SLOTS), seen(seed, 2, SLOTS)
    for name in ("occupancy_precision", "colour_precision"):
        a, b = (np.asarray(m.dense(getattr(m, name))) for m in (before, after))
        assert (b >= a).all()


@given(seeds)
def test_blocks_without_a_slot_are_reported_and_change_nothing(seed: int) -> None:
    """With too few slots every stored block is exact, every other one is at the prior, and both are counted."""
    dense, full = seen(seed, 1, None), seen(seed, 1, 12)
    needed = int(np.asarray(dense.occupancy_precision > 0.02).any(axis=1).sum())
    assume(needed > 11)
    assert int(full.table.used) == 12
    assert int(full.table.refused) == needed - 11
    assert_sound(full)
    stored = np.asarray(full.table.slot) != PRIOR_SLOT
    cells = np.kron(stored, np.ones((BLOCK,) * 3, bool))
    for name in ("occupancy", "occupancy_precision", "colour_precision"):
        a, b = (np.asarray(m.dense(getattr(m, name))) for m in (full, dense))
        np.testing.assert_allclose(a[cells], b[cells], atol=1e-6)
        assert len(np.unique(a[~cells])) == 1


def test_the_mesh_of_a_sparse_map() -> None:
    a, b = (surface_mesh(seen(3, 4, slots)) for slots in (None, SLOTS))
    assert len(a.faces) > 200
    np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-5)
    np.testing.assert_array_equal(a.faces, b.faces)


def test_replaced_means_leave_the_prior_unchanged() -> None:
    m = seen(1, 2, SLOTS)
    shifted = m.with_occupancy(m.occupancy + 0.05)
    assert_sound(m.with_occupancy(m.occupancy))
    np.testing.assert_array_equal(np.asarray(shifted.occupancy[PRIOR_SLOT]), np.float32(PRIOR_OCCUPANCY_MEAN))


def test_a_large_grid_needs_memory_for_stored_blocks_only() -> None:
    """2000^3 cells, 8 x 10^9, of which 100 blocks may be observed."""
    m = VoxelMap.sparse_cube((0.0, 0.0, 0.0), extent=100.0, voxel_size=0.05, slots=100)
    assert m.shape == (2000, 2000, 2000)
    rows = sum(a.nbytes for a in (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision))
    assert rows == 100 * 512 * 4 * 6


# --- files -----------------------------------------------------------------------------------------------------------


@settings(max_examples=8)  # each number of stored blocks compiles anew
@given(seeds)
def test_save_and_load_a_sparse_map(tmp_path_factory, seed: int) -> None:
    path = tmp_path_factory.mktemp("map") / "map.npz"
    m = seen(seed, 2, SLOTS)
    m.save(path, scene="oak")
    again = VoxelMap.load(path)
    assert read_metadata(path)["version"] == 2
    assert again.occupancy.shape == m.occupancy.shape
    assert int(again.table.used) == int(m.table.used)
    for name in ARRAYS:
        a, b = (np.asarray(n.dense(getattr(n, name))) for n in (m, again))
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(np.asarray(again.origin), np.asarray(m.origin))
    assert float(again.voxel_size) == float(m.voxel_size)
    assert_sound(again)
    again.save(path.with_name("again.npz"), scene="oak")
    assert path.read_bytes() == path.with_name("again.npz").read_bytes()


# --- the window moves ------------------------------------------------------------------------------------------------


def shifted(array: np.ndarray, shift: np.ndarray, fill: float) -> np.ndarray:
    """Return (nx, ny, nz, ...) cells of the window moved by whole blocks."""
    out = np.full_like(array, fill)
    spans = [(max(0, BLOCK * s), min(n, n + BLOCK * s)) for s, n in zip(shift, array.shape, strict=False)]
    if all(a < b for a, b in spans):
        old = tuple(slice(a, b) for a, b in spans)
        new = tuple(slice(a - BLOCK * s, b - BLOCK * s) for (a, b), s in zip(spans, shift, strict=True))
        out[new] = array[old]
    return out


@given(seeds, st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(-10, 10)), st.booleans())
@example(181, (0, -2, -6), True)  # blocks without storage, whose surface lay in a block that left
def test_the_overlap_of_both_windows_is_kept(seed: int, shift: tuple[int, int, int], is_sparse: bool) -> None:
    m = seen(seed, 3, SLOTS if is_sparse else None)
    before = {name: np.asarray(m.dense(getattr(m, name))) for name in ARRAYS}
    origin = np.asarray(m.origin, float)
    moved, dropped = move(copy(m), jnp.asarray(shift, jnp.int32))
    priors = (PRIOR_OCCUPANCY_MEAN, 0.01, 0.0, 0.01)
    for name, prior in zip(ARRAYS, priors, strict=True):
        expected = shifted(before[name], np.array(shift), prior)
        np.testing.assert_array_equal(np.asarray(moved.dense(getattr(moved, name))), expected, err_msg=name)
    np.testing.assert_allclose(np.asarray(moved.origin), origin + VOXEL * BLOCK * np.array(shift), atol=1e-6)
    observed = before["occupancy_precision"].reshape(6, 8, 5, 8, 9, 8) > 0.02
    after = np.asarray(moved.dense(moved.occupancy_precision)).reshape(6, 8, 5, 8, 9, 8) > 0.02
    assert int(dropped) == observed.any(axis=(1, 3, 5)).sum() - after.any(axis=(1, 3, 5)).sum()
    if is_sparse:
        assert_sound(moved)
    else:
        fresh = build(moved.occupancy, None)
        np.testing.assert_array_equal(np.asarray(moved.empty.rings), np.asarray(fresh.rings))
        np.testing.assert_array_equal(np.asarray(moved.empty.level), np.asarray(fresh.level))


@pytest.mark.parametrize("shift", [(-1, 0, 0), (0, -1, 0), (0, 0, -2), (1, 1, -1)])
def test_the_index_follows_surfaces_at_the_windows_border(shift: tuple[int, int, int]) -> None:
    """In a solid window, new blocks beside it have surfaces, and those at its end lose their neighbours."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    moved, _ = move(m.with_occupancy(jnp.full_like(m.occupancy, 0.2)), jnp.asarray(shift, jnp.int32))
    fresh = build(moved.occupancy, None)
    np.testing.assert_array_equal(np.asarray(moved.empty.rings), np.asarray(fresh.rings))
    np.testing.assert_array_equal(np.asarray(moved.empty.level), np.asarray(fresh.level))


def test_a_rolling_window_reuses_its_slots() -> None:
    """In a walk of 40 moves the slots of dropped blocks are used again, and no block is missing."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, SLOTS)
    for i in range(40):
        shift = np.array([2 if i % 2 else -1, (-1) ** (i // 3), 0])
        m, _ = move(m, jnp.asarray(shift, jnp.int32))
        T = pose(i)
        image = ROOM.image(T, CAMERA)
        T[:3, 3] += np.asarray(m.origin, float) - ORIGIN  # the room moves with the window
        m = update(m, image.depth, image.rgb, f32(T), CAMERA)
    assert int(m.table.refused) == 0
    assert_sound(m)
    assert bool(render(m, f32(T), CAMERA).known.mean() > 0.8)


@given(st.tuples(*[st.floats(-9.0, 9.0)] * 3))
def test_the_shift_brings_the_camera_to_the_middle(position: tuple[float, float, float]) -> None:
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, 2)
    middle = m.bounds.mean(axis=0)
    shift = np.asarray(shift_to_centre(m, f32(np.array(position)), 1.5))
    off = np.array(position) - middle
    if np.abs(off).max() < 1.49:
        assert not shift.any()
    elif np.abs(off).max() > 1.51:
        assert np.abs(off - shift * BLOCK * VOXEL).max() < 0.5 * BLOCK * VOXEL + 1e-4


# --- lists -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 100, 5000])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.6, 1.0])
def test_set_flags_are_listed_in_order(n: int, share: float) -> None:
    mask = np.random.default_rng(n).uniform(size=n) < share
    expected = np.flatnonzero(mask)
    ids, count = map(np.asarray, jax.jit(set_numbers)(jnp.asarray(mask)))
    assert count == len(expected)
    np.testing.assert_array_equal(ids[:count], expected)
    assert (ids[count:] == n).all()
    some = np.asarray(jax.jit(first_set, static_argnums=1)(jnp.asarray(mask), 50))
    np.testing.assert_array_equal(some, np.append(expected, np.full(50, n))[:50])


def test_files_of_a_dense_map_have_version_1(tmp_path: Path) -> None:
    VoxelMap.prior(ORIGIN, VOXEL, (8, 8, 8)).save(tmp_path / "map.npz")
    assert read_metadata(tmp_path / "map.npz")["version"] == 1
