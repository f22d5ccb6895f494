"""Test expected information against the map update itself, enumeration by hand, and the laws of mutual information."""

from itertools import permutations
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.random_maps import ORIGIN, SHAPE, VOXEL, random_map, seeds
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.speed import CompileCounter
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.planning.exploration.information import (
    InformationConfig,
    entropy,
    expected_gain,
    gain_of_paths,
    information_sum,
)
from vssm_gym.planning.exploration.information.gain import imagined_camera
from vssm_gym.planning.exploration.information.imagined import draw, imagine
from vssm_gym.planning.exploration.information.observed import Grid, Observed, heights, observed

CAMERA = Camera.from_hfov(20, 15, np.radians(75))
ROOM = Room(((-1.05, -0.75, 0.4), (1.05, 1.35, 1.75)), (((0.2, 0.1, 0.4), (0.6, 0.7, 1.1)),))
CLEAR = MapUpdateConfig(max_depth=2.5)
ALL = InformationConfig(pixels=None, every=1, update=CLEAR, max_depth=2.5)


def random_poses(rng: np.random.Generator, n: int, spread: float = 0.25) -> np.ndarray:
    """Draw camera poses in the middle of the grid, level to within 20 degrees."""
    middle = np.array(ORIGIN) + 0.5 * VOXEL * np.array(SHAPE)
    size = spread * VOXEL * np.array(SHAPE)
    poses = [(middle + size * rng.uniform(-1, 1, 3), rng.uniform(-0.35, 0.35, 3) * (9, 1, 1)) for _ in range(n)]
    return np.stack([camera_pose(tuple(p), *angles) for p, angles in poses]).astype(np.float32)


def partial_map(seed: int, images: int = 2, sparse: bool = False) -> VoxelMap:
    """Return the map after an update by a few images of a room that is larger than they show."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, slots=20 if sparse else None)
    for T in random_poses(np.random.default_rng(seed), images):
        image = ROOM.image(T.astype(float), CAMERA)
        m = update(m, image.depth, image.rgb, jnp.asarray(T), CAMERA, CLEAR)
    return m


def brute_force(m: VoxelMap, T_world_cam: np.ndarray, config: InformationConfig) -> np.ndarray:
    """Return the fall of entropy as the map update adds each image imagined in ``m`` along one trajectory."""
    start, depths, along = entropy(m), imagine(m, T_world_cam, CAMERA, config.max_depth), []
    m = jax.tree.map(jnp.copy, m)
    for depth, T in zip(depths, T_world_cam, strict=True):
        rgb = jnp.zeros((*depth.shape, 3))
        m = update(m, jnp.asarray(depth), rgb, jnp.asarray(T), CAMERA, config.update)
        along.append(start - entropy(m))
    return np.array(along)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("update_config", "sparse"),
    [
        pytest.param(CLEAR, False, id="dense"),
        pytest.param(CLEAR, True, id="sparse"),
        pytest.param(MapUpdateConfig(4.0, std=0.2, max_depth=2.0), False, id="long band", marks=pytest.mark.slow),
        pytest.param(MapUpdateConfig(std=30.0, min_depth=0.4), False, id="blunt, not near", marks=pytest.mark.slow),
    ],
)
def test_the_gain_is_the_entropy_that_the_update_takes_away(update_config: MapUpdateConfig, sparse: bool) -> None:
    config = InformationConfig(pixels=None, every=1, update=update_config, max_depth=update_config.max_depth)
    for seed in range(4):
        m = partial_map(seed, sparse=sparse)
        T = random_poses(np.random.default_rng([seed, 1]), 5)
        T[4] = T[1]  # the same look twice
        gain = expected_gain(m, T[None], CAMERA, config)
        np.testing.assert_allclose(gain.along[0], brute_force(m, T, config), rtol=1e-4)


@given(seeds)
def test_a_view_holds_the_cells_whose_precision_the_update_raises(seed: int) -> None:
    """This holds cell by cell, on images with holes and jumps, from poses in and around the grid."""
    rng = np.random.default_rng(seed)
    depth = (rng.uniform(0.1, 2.0) + rng.uniform(0, 1.5, (15, 20)) * (rng.uniform(size=(15, 20)) < 0.3)).astype(
        np.float32
    )
    depth[rng.uniform(size=depth.shape) < 0.1] = 0.0
    T = random_poses(rng, 1, spread=0.7)[0]
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    before = np.asarray(m.occupancy_precision).copy()
    grid = Grid.of(m)
    m = update(m, jnp.asarray(depth), jnp.zeros((15, 20, 3)), jnp.asarray(T), CAMERA, CLEAR)
    expected = np.asarray(m.occupancy_precision) > before
    wrong = cells_of(observed(depth[None], T[None], CAMERA, grid, CLEAR, 1)[0], len(before), 1) != expected
    assert wrong.sum() <= 2  # a cell on the border between two pixels, or at the band's end
    for every in (2, 4, 8):
        chosen = np.zeros(BLOCK**3, bool)
        chosen[np.arange(64) * BLOCK + heights(every)] = True
        part = cells_of(observed(depth[None], T[None], CAMERA, grid, CLEAR, every)[0], len(before), every)
        assert (part != (expected & chosen)).sum() <= 2


def cells_of(view: Observed, blocks: int, every: int) -> np.ndarray:
    """Return ``(blocks, 512)`` flags of the bits of a view; each block is listed once."""
    assert len(set(view.block)) == len(view.block)
    flags = np.zeros((blocks, BLOCK**3), bool)
    bits = (view.words[:, :, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    flags[view.block[:, None, None], np.arange(64) * BLOCK + heights(every)] = bits.astype(bool)
    return flags


@pytest.mark.parametrize("every", [2, 4, 8])
def test_the_subset_has_cells_of_every_plane_in_proportion(every: int) -> None:
    chosen = np.zeros(BLOCK**3, bool)
    chosen[np.arange(64) * BLOCK + heights(every)] = True
    planes = chosen.reshape(BLOCK, BLOCK, BLOCK)
    for axes in permutations(range(3), 2):
        np.testing.assert_array_equal(planes.sum(axis=axes), 64 // every)


def test_a_map_of_3x3x1_cells_by_hand() -> None:
    """Enumerate cells a metre apart, each with a precision of its own, in fully known surroundings.

    The middle cell is solid and its neighbours are 0.5 m before the surface, so the surface is halfway between them. A
    band of a quarter of a cell: from each side only the three cells in front of it are seen, the corners by the outer
    pixels past the middle and the cell between them by the middle one.
    """
    m = VoxelMap.prior((-3.0, -3.0, -4.0), 1.0, (BLOCK, BLOCK, BLOCK))
    occupancy, precision = np.full(m.shape, -0.5, np.float32), np.full(m.shape, 1e12, np.float32)
    occupancy[4, 4, 4] = 0.5
    lam = np.arange(1.0, 10.0).reshape(3, 3)  # of cell (x, y)
    precision[3:6, 3:6, 4] = lam
    m = m.with_occupancy(m.blocked(jnp.asarray(occupancy)))
    m = eqx.tree_at(lambda m: m.occupancy_precision, m, m.blocked(jnp.asarray(precision)))
    camera = Camera(3, 1, 0.9, 0.9, 1.0, 0.0)
    update_config = MapUpdateConfig(truncation=0.25, std=0.5, max_depth=1.9)  # weight 4
    config = InformationConfig(pixels=None, every=1, update=update_config, max_depth=1.6)
    west = camera_pose((-1.0, 1.0, 0.0), 0.0)  # looks along +x
    east = camera_pose((3.0, 1.0, 0.0), np.pi)
    south = camera_pose((1.0, -1.0, 0.0), np.pi / 2)
    gain = expected_gain(m, np.stack([west, east, west, south])[None], camera, config)
    n = np.zeros((3, 3))
    looks: list[Any] = [np.s_[0, :], np.s_[2, :], np.s_[0, :], np.s_[:, 0]]
    for step, cells in enumerate(looks):
        n[cells] += 1
        np.testing.assert_allclose(gain.along[0, step], 0.5 * np.log(1.0 + 4.0 * n / lam).sum(), rtol=1e-6)
    by_hand = 0.5 * (
        np.log(1 + 12 / 1) + np.log(1 + 8 / 2) + np.log(1 + 8 / 3)  # x = 0: y = 0 three times, the others twice
        + np.log(1 + 4 / 4)  # x = 1: y = 0 once, from the south; y = 1 is solid
        + np.log(1 + 8 / 7) + np.log(1 + 4 / 8) + np.log(1 + 4 / 9)  # x = 2: y = 0 twice
    )  # fmt: skip
    assert gain.total[0] == pytest.approx(by_hand, rel=1e-6)


@given(seeds, st.sampled_from(["blobs", "distance", "thin walls", "empty"]))
def test_laws_of_information(seed: int, kind: str) -> None:
    m = random_map(kind, seed)
    rng = np.random.default_rng(seed)
    T = random_poses(rng, 12)
    paths = rng.integers(-1, 12, (8, 5))
    paths[1, :3] = paths[0, :3]  # a common beginning
    config = InformationConfig(pixels=None, every=8, update=CLEAR, max_depth=2.5)
    gain = gain_of_paths(m, T, paths, CAMERA, config)
    single = gain_of_paths(m, T, np.arange(12)[:, None], CAMERA, config).total
    np.testing.assert_array_equal(gain.total, gain.along[:, -1])
    assert (np.diff(gain.along, axis=1) >= 0).all()
    added = np.diff(gain.along, axis=1, prepend=0.0)
    assert (added[paths == -1] == 0.0).all()
    # Submodular: a view adds no more after others than alone, and no step has more gain than all.
    assert (added <= np.where(paths >= 0, single[paths], 0.0) * (1 + 1e-9) + 1e-9).all()
    # The order of the views, and other trajectories in the same call, change nothing.
    np.testing.assert_allclose(gain_of_paths(m, T, paths[:, ::-1], CAMERA, config).total, gain.total, rtol=1e-9)
    alone = gain_of_paths(m, T, paths[3:4], CAMERA, config)
    np.testing.assert_allclose(alone.along[0], gain.along[3], rtol=1e-9)


def test_a_repeated_view_adds_what_the_next_update_adds() -> None:
    m, T = VoxelMap.prior(ORIGIN, VOXEL, SHAPE), random_poses(np.random.default_rng(0), 1)
    gain = expected_gain(m, np.repeat(T[None], 4, axis=1), CAMERA, ALL)
    cells = gain.along[0, 0] / (0.5 * np.log(1 + PRIOR_OCCUPANCY_STD**2))
    assert cells > 1000
    n = np.arange(1, 5)
    np.testing.assert_allclose(gain.along[0], cells * 0.5 * np.log(1 + n * PRIOR_OCCUPANCY_STD**2), rtol=1e-6)


def test_padded_steps_do_not_change_a_trajectory() -> None:
    m, T = partial_map(3), random_poses(np.random.default_rng(3), 6).reshape(2, 3, 4, 4)
    valid = np.array([[True, True, False], [False, False, False]])
    gain = expected_gain(m, np.where(valid[..., None, None], T, np.nan), CAMERA, ALL, valid)
    short = expected_gain(m, T[:1, :2], CAMERA, ALL)
    np.testing.assert_allclose(gain.along[0], short.along[0, [0, 1, 1]], rtol=1e-9)
    assert (gain.along[1] == 0.0).all()


def test_no_candidates() -> None:
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    none, no_steps = (expected_gain(m, np.zeros((*n, 4, 4)), CAMERA) for n in ((0, 3), (2, 0)))
    assert none.along.shape == (0, 3) and none.total.shape == (0,)
    assert no_steps.along.shape == (2, 0) and (no_steps.total == 0.0).all()
    away = camera_pose((50.0, 0.0, 0.0), 0.0)
    assert expected_gain(m, away[None, None], CAMERA).total == 0.0


def test_entropy_counts_from_the_prior() -> None:
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    assert entropy(m) == 0.0
    dense, sparse = partial_map(1), partial_map(1, sparse=True)
    assert entropy(dense) < 0.0
    assert entropy(sparse) == pytest.approx(entropy(dense), rel=1e-9)
    precision = np.asarray(dense.occupancy_precision, float)
    absolute = 0.5 * np.log(2 * np.pi * np.e / precision).sum()
    at_prior = precision.size * 0.5 * np.log(2 * np.pi * np.e * PRIOR_OCCUPANCY_STD**2)
    assert entropy(dense) == pytest.approx(absolute - at_prior, rel=1e-6)


def test_unknown_space_has_gain_and_space_behind_a_wall_has_none() -> None:
    m, middle = partial_map(0, images=1), np.array(ORIGIN) + 0.5 * VOXEL * np.array(SHAPE)
    empty = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    T = camera_pose(tuple(middle), 0.3)[None]
    depth = imagine(empty, T, CAMERA, 2.5)
    np.testing.assert_array_equal(depth, np.float32(2.5))
    seen = expected_gain(empty, T[None], CAMERA, ALL).total[0]
    prior = jnp.full_like(m.occupancy_precision, PRIOR_OCCUPANCY_STD**-2)
    walled = eqx.tree_at(lambda m: m.occupancy_precision, ROOM.to_map(ORIGIN, VOXEL, SHAPE), prior)
    assert 0.0 < expected_gain(walled, T[None], CAMERA, ALL).total[0] < 0.9 * seen


def test_known_cells_have_no_gain_where_they_are_left_out() -> None:
    m, T = partial_map(2), random_poses(np.random.default_rng(2), 1)[None]
    everything = expected_gain(m, T, CAMERA, ALL).total[0]
    config = InformationConfig(pixels=None, every=1, update=CLEAR, max_depth=2.5, known=0.5)
    new = expected_gain(m, T, CAMERA, config).total[0]
    first_look = 0.5 * np.log(1 + PRIOR_OCCUPANCY_STD**2)
    assert 0.0 < new < everything
    assert new / first_look == pytest.approx(
        round(new / first_look), abs=1e-3
    )  # whole cells, each seen for the first time


@pytest.mark.slow
def test_rays_in_sampled_unknown_space_have_the_configured_mean_length() -> None:
    """``E[min(d, D)] = L (1 - exp(-D / L))`` for obstacles that are a Poisson process."""
    m = VoxelMap.prior((0.0, 0.0, 0.0), 0.1, (48, 48, 48))
    camera = Camera.from_hfov(20, 15, 0.5)  # rays about as long as their z-depth
    T = np.stack([camera_pose((2.4, 2.4, 2.4), yaw, pitch) for yaw in (0.0, 0.4, 0.8) for pitch in (0.0, 0.5)])
    for mean_free_path in (0.7, 1.5):
        read = np.mean([imagine(draw(seed, m, mean_free_path, 1.0), T, camera, 2.0) for seed in range(10)])
        assert read == pytest.approx(mean_free_path * (1 - np.exp(-2.0 / mean_free_path)), rel=0.15)


def test_samples_of_a_known_map_agree_with_its_mean() -> None:
    m, T = ROOM.to_map(ORIGIN, VOXEL, SHAPE), random_poses(np.random.default_rng(5), 6)[:, None]
    config = InformationConfig(pixels=None, every=1, update=CLEAR, max_depth=2.5, samples=2)
    mean, sampled = expected_gain(m, T, CAMERA, ALL).total, expected_gain(m, T, CAMERA, config).total
    np.testing.assert_allclose(sampled, mean, rtol=0.1)
    again = expected_gain(m, T, CAMERA, config).total
    np.testing.assert_array_equal(sampled, again)  # the same samples in every call
    unknown = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    shorter = expected_gain(unknown, T, CAMERA, config).total
    assert (shorter < expected_gain(unknown, T, CAMERA, ALL).total).all()  # the mean is optimistic


def test_nothing_is_compiled_again_for_other_candidates() -> None:
    m, T = partial_map(0), random_poses(np.random.default_rng(0), 40)
    expected_gain(m, T[:4].reshape(2, 2, 4, 4), CAMERA)
    counter, signatures = CompileCounter(), len(information_sum._count.signatures)
    expected_gain(m, T[:21].reshape(7, 3, 4, 4), CAMERA)
    expected_gain(m, T.reshape(8, 5, 4, 4), CAMERA, valid=np.arange(40).reshape(8, 5) % 3 > 0)
    assert (counter.count, len(information_sum._count.signatures)) == (0, signatures)


def test_an_imagined_image_covers_the_view_with_at_least_the_configured_pixels() -> None:
    small = imagined_camera(Camera.from_hfov(160, 120, 1.2), 1200)
    assert (small.width, small.height) == (40, 30)
    odd = imagined_camera(Camera.from_hfov(101, 67, 1.2), 1200)
    assert 1200 <= odd.width * odd.height < 1400
    assert imagined_camera(CAMERA, 1200) is CAMERA  # 300 pixels: no more than there are


@pytest.mark.parametrize(
    "change",
    [
        {"pixels": 0},
        {"every": 3},
        {"max_depth": 9.0},
        {"max_depth": 0.01},
        {"samples": -1},
        {"mean_free_path": 0.0},
        {"ground": np.nan},
    ],
)
def test_a_bad_configuration_is_refused(change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        InformationConfig(**change)


def test_bad_input_is_refused() -> None:
    m, T = VoxelMap.prior(ORIGIN, VOXEL, SHAPE), random_poses(np.random.default_rng(0), 2)
    with pytest.raises(InputError, match="T_world_cam"):
        expected_gain(m, T, CAMERA)
    for hazard in (-1.0, np.nan, np.ones((2, 2))):
        with pytest.raises(InputError, match="hazard"):
            expected_gain(m, T[None], CAMERA, hazard=hazard)
    with pytest.raises(InputError, match="valid"):
        expected_gain(m, T[None], CAMERA, valid=np.ones((2, 1), bool))
    with pytest.raises(InputError, match="finite"):
        expected_gain(m, np.full((1, 1, 4, 4), np.nan), CAMERA)
    with pytest.raises(InputError, match="paths"):
        gain_of_paths(m, T, np.array([[2]]), CAMERA)
    with pytest.raises(InputError, match="samples"):
        expected_gain(partial_map(0, sparse=True), T[None], CAMERA, InformationConfig(samples=1))
