"""Test the closed-form map update against a dense float64 oracle, and the laws of Bayes' rule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose, cell_centres
from tests.helpers.random_maps import ORIGIN, SHAPE, VOXEL, seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_exp, transform
from vssm_gym.inference.mapping.map_update import MapUpdateConfig, update, update_expected
from vssm_gym.inference.mapping.visible_blocks import blocks_in_view, depth_ceilings
from vssm_gym.maps import empty_space
from vssm_gym.maps.voxel_map import (
    OBSERVATION_COLOUR_STD,
    OBSERVATION_STD,
    PRIOR_COLOUR_STD,
    PRIOR_OCCUPANCY_MEAN,
    PRIOR_OCCUPANCY_STD,
    VoxelMap,
)
from vssm_gym.model.emission import render

CAMERA = Camera.from_hfov(20, 15, np.radians(75))
CONFIG = MapUpdateConfig()
TRUNCATION = CONFIG.truncation * VOXEL


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def random_image(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw depth with holes and jumps, colour, and a pose in or around the grid; float32 values."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.1, 3.0) + rng.uniform(-0.3, 0.3, 2) @ np.indices((15, 20)).reshape(2, -1) / 15
    depth = depth.reshape(15, 20) + rng.uniform(0.0, 1.5) * (rng.uniform(size=(15, 20)) < 0.2)
    depth = np.where(rng.uniform(size=depth.shape) < 0.1, 0.0, np.maximum(depth, 0.0))
    position = np.array(ORIGIN) + VOXEL * np.array(SHAPE) * rng.uniform(-0.3, 1.3, 3)
    T = camera_pose(tuple(position), *rng.uniform(-3.0, 3.0, 3))
    return np.asarray(depth, np.float32), rng.uniform(size=(15, 20, 3)).astype(np.float32), np.asarray(T, np.float32)


def observation_oracle(
    depth: np.ndarray, rgb: np.ndarray, T_world_cam: np.ndarray, m: VoxelMap
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Observe every cell of the grid in float64 (PRISM, step 5).

    Returns weight and value of occupancy, weight and value of colour, and where rounding cannot change which pixel a
    cell falls on, nor whether it lies in the band.
    """
    p_cam = transform(inverse(T_world_cam.astype(float)), cell_centres(m).reshape(-1, 3))
    z = p_cam[:, 2]
    ahead = z > CONFIG.min_depth
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = (p_cam @ CAMERA.K.T)[:, :2] / z[:, None]
    uv = np.where(ahead[:, None], np.clip(uv, -1e6, 1e6), -100.0)
    pixel = np.rint(uv).astype(int)
    inside = ahead & (pixel >= 0).all(axis=1) & (pixel < [CAMERA.width, CAMERA.height]).all(axis=1)
    u, v = np.where(inside[:, None], pixel, 0).T
    d = depth[v, u].astype(float)
    valid = inside & np.isfinite(d) & (d > CONFIG.min_depth) & (d <= CONFIG.max_depth)
    sdf = np.where(valid, d - z, 0.0)
    seen = valid & (sdf > -TRUNCATION)
    clear = (np.abs(uv - np.floor(uv) - 0.5) > 1e-3).all(axis=1) & (np.abs(z - CONFIG.min_depth) > 1e-4)
    clear &= np.abs(np.abs(sdf) - TRUNCATION) > 1e-4
    weight = CONFIG.std**-2
    return weight * seen, -np.clip(sdf, -TRUNCATION, TRUNCATION), weight * (seen & (sdf < TRUNCATION)), rgb[v, u], clear


class DensePosterior:
    """Solve one least-squares problem a cell from the prior and all its observations, at the end."""

    def __init__(self, m: VoxelMap) -> None:
        self.m, n = m, int(np.prod(m.shape))
        self.o_weight, self.o_sum = (
            np.full(n, PRIOR_OCCUPANCY_STD**-2),
            np.full(n, PRIOR_OCCUPANCY_STD**-2 * PRIOR_OCCUPANCY_MEAN),
        )
        self.c_weight, self.c_sum = np.full(n, PRIOR_COLOUR_STD**-2), np.zeros((n, 3))
        self.clear = np.ones(n, bool)

    def add(self, depth: np.ndarray, rgb: np.ndarray, T_world_cam: np.ndarray) -> None:
        w_o, o, w_c, c, clear = observation_oracle(depth, rgb, T_world_cam, self.m)
        self.o_weight, self.o_sum = self.o_weight + w_o, self.o_sum + w_o * o
        self.c_weight, self.c_sum = self.c_weight + w_c, self.c_sum + w_c[:, None] * c
        self.clear &= clear

    def assert_equals(self, m: VoxelMap) -> None:
        k = self.clear
        assert k.mean() > 0.9
        np.testing.assert_allclose(flat(m, m.occupancy_precision)[k], self.o_weight[k], rtol=1e-6)
        np.testing.assert_allclose(flat(m, m.occupancy)[k], (self.o_sum / self.o_weight)[k], atol=2e-6)
        np.testing.assert_allclose(flat(m, m.colour_precision)[k], self.c_weight[k], rtol=1e-6)
        colour = self.c_sum / self.c_weight[:, None]
        np.testing.assert_allclose(flat(m, m.colour)[k], colour[k], atol=2e-6)


def flat(m: VoxelMap, array: jax.Array) -> np.ndarray:
    """Return cells in the order of the dense grid, (cells[, channels])."""
    dense = np.asarray(m.dense(array), float)
    return dense.reshape(-1, *dense.shape[3:])


def empty_map() -> VoxelMap:
    return VoxelMap.prior(ORIGIN, VOXEL, SHAPE)


def updated(m: VoxelMap, depth: np.ndarray, rgb: np.ndarray, T_world_cam: np.ndarray) -> VoxelMap:
    """Call ``update`` on a copy, since it consumes its map."""
    return update(jax.tree.map(jnp.copy, m), f32(depth), f32(rgb), f32(T_world_cam), CAMERA, CONFIG)


@given(seeds, st.integers(1, 4))
def test_the_posterior_is_the_dense_one(seed: int, images: int) -> None:
    """Cell by cell, sequential updates equal one dense solve, precisions included."""
    m = empty_map()
    oracle = DensePosterior(m)
    for i in range(images):
        image = random_image(seed + i)
        m = updated(m, *image)
        oracle.add(*image)
    oracle.assert_equals(m)


@given(seeds)
def test_the_empty_space_index_is_updated(seed: int) -> None:
    """After several updates it equals the index of the means, block for block."""
    m = empty_map()
    for i in range(3):
        m = updated(m, *random_image(seed + i))
    fresh = build(m.occupancy)
    np.testing.assert_array_equal(np.asarray(m.empty.level), np.asarray(fresh.level))
    np.testing.assert_array_equal(np.asarray(m.empty.rings), np.asarray(fresh.rings))


build = jax.jit(lambda occupancy: empty_space.build(occupancy, empty_map().blocks))


@given(seeds)
def test_precisions_never_fall(seed: int) -> None:
    before = updated(empty_map(), *random_image(seed))
    after = updated(before, *random_image(seed + 1))
    assert bool((after.occupancy_precision >= before.occupancy_precision).all())
    assert bool((after.colour_precision >= before.colour_precision).all())
    # Where nothing was learned nothing changed, to the bit
    same = np.asarray(after.occupancy_precision == before.occupancy_precision)
    np.testing.assert_array_equal(np.asarray(after.occupancy)[same], np.asarray(before.occupancy)[same])
    uncoloured = np.asarray(after.colour_precision == before.colour_precision)
    a, b = (np.moveaxis(np.asarray(m.colour), 1, -1)[uncoloured] for m in (after, before))
    np.testing.assert_array_equal(a, b)


@given(seeds)
def test_the_order_of_images_does_not_matter(seed: int) -> None:
    first, second = random_image(seed), random_image(seed + 1)
    a = updated(updated(empty_map(), *first), *second)
    b = updated(updated(empty_map(), *second), *first)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if x.dtype == jnp.float32:
            np.testing.assert_allclose(np.asarray(x), np.asarray(y), atol=1e-6)


def assert_every_written_block_is_listed(depth: np.ndarray, T_world_cam: np.ndarray) -> bool:
    """Assert that every block with a cell that the oracle updates is listed; return whether there was one."""
    m = empty_map()
    weight, _, _, _, clear = observation_oracle(depth, np.zeros((15, 20, 3)), T_world_cam, m)
    written = np.asarray(m.blocked(jnp.asarray((weight * clear).reshape(m.shape)))).any(axis=1)
    listed = view(f32(depth), f32(np.linalg.inv(T_world_cam)))
    assert not (written & ~listed).any()
    return bool(written.any())


@given(seeds)
def test_no_block_in_view_is_missed(seed: int) -> None:
    depth, _, T = random_image(seed)
    assert_every_written_block_is_listed(depth, T)


@given(seeds)
def test_no_block_behind_a_single_pixel_is_missed(seed: int) -> None:
    """With a single reading, a block is found even where only one of its corners projects to that pixel."""
    rng, found = np.random.default_rng(seed), 0
    for _ in range(8):
        T, depth = camera_pose((0.0, 0.0, 0.0), *rng.uniform(-3.0, 3.0, 3)), np.zeros((15, 20), np.float32)
        u, v, d = rng.integers(20), rng.integers(15), rng.uniform(0.3, 3.0)
        corner = np.array(ORIGIN) + VOXEL * (8 * rng.integers(0, empty_map().blocks) + 7 * rng.integers(0, 2, 3))
        pixel = np.array([u, v, 1.0]) + np.append(rng.uniform(-0.49, 0.49, 2), 0.0)
        T[:3, 3] = corner - T[:3, :3] @ np.linalg.inv(CAMERA.K) @ pixel * d  # the pixel sees that corner of a block
        depth[v, u] = d
        found += assert_every_written_block_is_listed(depth, T)
    assert found > 4


@given(seeds)
def test_no_block_in_the_band_behind_a_wall_is_missed(seed: int) -> None:
    """The camera looks at a block along its diagonal, and the wall stands just before the block's nearest cell."""
    rng, m, found = np.random.default_rng(seed), empty_map(), 0
    for _ in range(4):
        block = rng.integers(0, m.blocks)
        corner = rng.integers(0, 2, 3)
        cell = np.array(ORIGIN) + VOXEL * (8 * block + 7 * corner)
        outward = (2.0 * corner - 1.0) / np.sqrt(3.0)
        yaw, pitch = np.arctan2(-outward[1], -outward[0]), np.arcsin(outward[2])
        distance = rng.uniform(0.5, 3.0)
        T = camera_pose(tuple(cell + distance * outward), yaw, pitch, rng.uniform(-3.0, 3.0))
        depth = np.full((15, 20), distance - rng.uniform(0.0, TRUNCATION), np.float32)
        found += assert_every_written_block_is_listed(depth, T)
    assert found > 0


def view(depth: jax.Array, T_cam_world: jax.Array) -> np.ndarray:
    """Return which blocks are listed, (blocks,) bool; each is listed once."""
    ids, count = map(np.asarray, list_view(depth, T_cam_world[None]))
    blocks = int(np.prod(empty_map().blocks))
    assert (ids[count:] == blocks).all()
    assert len(np.unique(ids[:count])) == count
    return np.isin(np.arange(blocks), ids[:count])


list_view = jax.jit(lambda depth, T: blocks_in_view(empty_map(), depth, T, CAMERA, CONFIG))


def test_blocks_out_of_view_are_not_listed() -> None:
    """A camera that faces away from the grid lists nothing; one before a wall lists nothing behind it."""
    depth, away = np.full((15, 20), 2.0), camera_pose((1.6, 0.3, 1.1), 0.0)
    assert not view(f32(depth), f32(np.linalg.inv(away))).any()
    towards = camera_pose((-1.5, 0.3, 1.1), 0.0)
    listed = view(f32(np.full((15, 20), 0.5)), f32(np.linalg.inv(towards))).reshape(empty_map().blocks)
    assert listed[0].any()
    assert not listed[1:].any()  # the wall stands at x = -1.0, blocks are 0.8 m wide from x = -1.2


@given(seeds)
def test_depth_ceilings_are_maxima(seed: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.0, 5.0, (15, 20))
    for level, ceiling in enumerate(depth_ceilings(f32(depth))):
        size = 2**level
        for v, u in np.ndindex(ceiling.shape):
            tile = depth[v * size : (v + 1) * size, u * size : (u + 1) * size]
            assert float(ceiling[v, u]) == pytest.approx(tile.max(initial=0.0), rel=1e-6)
    assert ceiling.shape == (1, 1)


def test_one_pixel_by_hand() -> None:
    """A camera on the x axis sees a wall 1.0 m ahead. Prior precision 0.01, observation 1:

    a cell 0.1 m before the wall, -0.1 / 1.01; on it, ~0; 0.1 m behind, +0.1 / 1.01; 0.5 m before, clipped to
    -0.2 / 1.01; 0.3 m behind, beyond the band: still the prior.
    """
    m = VoxelMap.prior((0.0, 0.0, 0.0), VOXEL, SHAPE)
    T = camera_pose((0.1, 0.3, 0.3), 0.0)
    rgb = np.broadcast_to([0.2, 0.4, 0.6], (15, 20, 3))
    m = update(m, jnp.full((15, 20), 1.0), f32(rgb), f32(T), CAMERA, CONFIG)
    occupancy, precision = (np.asarray(m.dense(a))[:, 3, 3] for a in (m.occupancy, m.occupancy_precision))
    colour, colour_precision = (np.asarray(m.dense(a))[:, 3, 3] for a in (m.colour, m.colour_precision))
    cells = [10, 11, 12, 6, 14]  # x = 1.0, 1.1, 1.2, 0.6, 1.4; the wall is at 1.1
    prior = 0.01 * -0.001
    expected = [(prior - 0.1) / 1.01, prior / 1.01, (prior + 0.1) / 1.01, (prior - 0.2) / 1.01, -0.001]
    np.testing.assert_allclose(occupancy[cells], expected, atol=1e-6)
    np.testing.assert_allclose(precision[cells], [1.01, 1.01, 1.01, 1.01, 0.01], rtol=1e-6)
    np.testing.assert_allclose(colour_precision[cells], [1.01, 1.01, 1.01, 0.01, 0.01], rtol=1e-6)  # not in free space
    np.testing.assert_allclose(colour[11], np.array([0.2, 0.4, 0.6]) / 1.01, rtol=1e-5)
    np.testing.assert_allclose(colour[6], 0.0)


def test_invalid_readings_change_nothing() -> None:
    _, rgb, _ = random_image(3)
    T = camera_pose((0.0, 0.2, 1.0), 0.4)
    before = updated(empty_map(), np.full((15, 20), 1.0), rgb, T)
    for value in (0.0, np.nan, np.inf, -np.inf, -1.0, CONFIG.max_depth + 0.1, 0.5 * CONFIG.min_depth):
        after = updated(before, np.full((15, 20), value), rgb, T)
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@given(seeds)
def test_an_invalid_reading_affects_no_other(seed: int) -> None:
    """NaN and out-of-range pixels are left out; the others update as if those were not there."""
    depth, rgb, T = random_image(seed)
    bad = np.random.default_rng(seed).choice([np.nan, np.inf, 50.0], depth.shape)
    spoiled = np.where(depth == 0.0, bad, depth)
    for a, b in zip(
        jax.tree.leaves(updated(empty_map(), depth, rgb, T)),
        jax.tree.leaves(updated(empty_map(), spoiled, rgb, T)),
        strict=True,
    ):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_updating_compiles_once() -> None:
    before = update._cache_size()
    m = empty_map()
    for i in range(4):
        depth, rgb, T = random_image(i)
        m = update(m, f32(depth), f32(rgb), f32(T), CAMERA, CONFIG)
    assert update._cache_size() - before <= 1


# --- expectation over the pose ---------------------------------------------------------------------------------------


def expected(m: VoxelMap, depth: np.ndarray, rgb: np.ndarray, T_samples: np.ndarray) -> VoxelMap:
    """Call ``update_expected`` on a copy, since it consumes its map."""
    return update_expected(jax.tree.map(jnp.copy, m), f32(depth), f32(rgb), f32(T_samples), CAMERA, CONFIG)


def around(T: np.ndarray, samples: int, std: float, seed: int) -> np.ndarray:
    """Draw (samples, 4, 4) poses ``T exp(delta)``, delta ~ N(0, std^2) in m and rad."""
    delta = std * np.random.default_rng([seed, 9]).standard_normal((samples, 6))
    return np.asarray(f32(T @ np.asarray(se3_exp(f32(delta)), float)))


@given(seeds)
def test_one_sample_is_the_plain_update(seed: int) -> None:
    depth, rgb, T = random_image(seed)
    a, b = updated(empty_map(), depth, rgb, T), expected(empty_map(), depth, rgb, T[None])
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


@given(seeds, st.sampled_from([0.003, 0.03, 0.3]))
def test_moments_over_samples_agree_with_float64(seed: int, std: float) -> None:
    """Cell by cell the mean is sum w o / sum w and the precision mean(w) / (1 + Var(o) / sigma^2)."""
    depth, rgb, T = random_image(seed)
    poses, m = around(T, 4, std, seed), empty_map()
    parts = [observation_oracle(depth, rgb, pose, m) for pose in poses]
    w, o, w_c, c = (np.stack([part[i] for part in parts]) for i in range(4))
    clear = np.all([part[4] for part in parts], axis=0)
    after = expected(m, depth, rgb, poses)
    with np.errstate(invalid="ignore"):
        mean, colour = (w * o).sum(0) / w.sum(0), (w_c[..., None] * c).sum(0) / w_c.sum(0)[:, None]
        variance = (w * (o - mean) ** 2).sum(0) / w.sum(0)
        variance_c = (w_c[..., None] * (c - colour) ** 2).sum(0).mean(-1) / w_c.sum(0)
    weight = np.nan_to_num(w.mean(0) / (1.0 + variance / OBSERVATION_STD**2))
    weight_c = np.nan_to_num(w_c.mean(0) / (1.0 + variance_c / OBSERVATION_COLOUR_STD**2))
    prior = PRIOR_OCCUPANCY_STD**-2
    expected_o = (prior * PRIOR_OCCUPANCY_MEAN + weight * np.nan_to_num(mean)) / (prior + weight)
    np.testing.assert_allclose(flat(m, after.occupancy_precision)[clear], (prior + weight)[clear], rtol=2e-3)
    np.testing.assert_allclose(flat(m, after.occupancy)[clear], expected_o[clear], atol=1e-4)
    prior_c = PRIOR_COLOUR_STD**-2
    expected_c = weight_c[:, None] * np.nan_to_num(colour) / (prior_c + weight_c)[:, None]
    np.testing.assert_allclose(flat(m, after.colour_precision)[clear], (prior_c + weight_c)[clear], rtol=2e-3)
    np.testing.assert_allclose(flat(m, after.colour)[clear], expected_c[clear], atol=1e-3)


def test_an_uncertain_pose_gives_less_precision_near_surfaces() -> None:
    """Precision in the band before a wall falls with the pose's noise; free space far from it is not affected."""
    T, rgb = camera_pose((-1.1, 0.25, 1.0), 0.0), np.full((15, 20, 3), 0.5)
    gains = []
    for std in (0.0, 0.01, 0.03, 0.1):
        m = expected(empty_map(), np.full((15, 20), 1.5), rgb, around(T, 8, std, 0))
        precision = np.asarray(m.dense(m.occupancy_precision))[:, 11:13, 7]  # along the optical axis; wall at x = 0.4
        gains.append((precision[15:17].mean(), precision[4:10].mean()))
        assert (precision >= 0.99 * PRIOR_OCCUPANCY_STD**-2).all()
    near, far = np.transpose(gains)
    assert (np.diff(near) < 0.0).all()
    assert near[0] == pytest.approx(1.01, rel=1e-5)
    assert near[-1] < 0.4 * near[0]
    assert far[-1] > 0.9 * far[0]


@given(seeds)
def test_precisions_never_fall_in_expectation(seed: int) -> None:
    depth, rgb, T = random_image(seed)
    before = updated(empty_map(), *random_image(seed + 1))
    after = expected(before, depth, rgb, around(T, 4, 0.1, seed))
    assert bool((after.occupancy_precision >= before.occupancy_precision).all())
    assert bool((after.colour_precision >= before.colour_precision).all())


# --- walls -----------------------------------------------------------------------------------------------------------

THICKNESS = 0.1
WALL = ((-0.5 * THICKNESS, -2.0, -1.0), (0.5 * THICKNESS, 2.0, 4.0))
TWO_ROOMS = Room(interior=((-1.2, -1.0, 0.0), (1.2, 1.0, 1.5)), boxes=(WALL,))
WALL_CAMERA = Camera.from_hfov(64, 48, np.radians(75))


def map_from_both_sides(voxel: float) -> VoxelMap:
    """Map a wall of 10 cm between two rooms, seen from three places in each, straight on and at up to 65 degrees."""
    m = VoxelMap.prior((-1.2, -1.0, -0.05), voxel, (48, 40, 32))  # the size that tracking's tests compile too
    for side in (-1, 1):
        for y, yaw in ((-0.5, 0.5), (0.0, 0.0), (0.5, -0.5)):
            T = camera_pose((side * 0.95, y, 0.75), yaw if side < 0 else np.pi - yaw)
            image = TWO_ROOMS.image(T, WALL_CAMERA)
            m = update(m, image.depth, image.rgb, f32(T), WALL_CAMERA, CONFIG)
    return m


@pytest.mark.parametrize("voxel", [0.05, 0.07])
def test_a_thin_wall_mapped_from_both_sides_is_still_a_wall(voxel: float) -> None:
    """The wall is solid in its middle, without holes, never thinner.

    Where the band of one side reaches past the wall into the free space before the other, both sides observe "inside":
    the faces move out by the truncation less the thickness, 4 cm for cells of 7 cm.
    """
    m = map_from_both_sides(voxel)
    y, z = np.meshgrid(np.linspace(-0.6, 0.6, 41), np.linspace(0.2, 1.3, 37))
    middle = np.stack([np.zeros_like(y), y, z], axis=-1)
    assert float(m.occupancy_at(f32(middle)).min()) > 0.2 * THICKNESS
    for side in (-1, 1):
        room = middle + np.array([side * (0.5 * THICKNESS + 2.5 * voxel), 0.0, 0.0])
        assert float(m.occupancy_at(f32(room)).max()) < 0.0  # the air before it is free
        T = camera_pose((side * 0.9, 0.1, 0.8), 0.0 if side < 0 else np.pi)
        image = render(m, f32(T), WALL_CAMERA)
        truth = TWO_ROOMS.depth(T, WALL_CAMERA)
        wall = np.abs(truth - (0.9 - 0.5 * THICKNESS)) < 1e-6
        assert wall.mean() > 0.5
        assert bool(np.asarray(image.hit)[wall].all())
        assert bool(np.asarray(image.known)[wall].all())
        error = np.asarray(image.depth)[wall] - truth[wall]
        thickening = max(0.0, CONFIG.truncation * voxel - THICKNESS)
        assert error.max() < 0.1 * voxel  # it is never eaten
        assert error.min() > -thickening - 0.5 * voxel
