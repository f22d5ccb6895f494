"""Test map uncertainty in images: propagation against sampled maps, exact sensitivities, laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.localisation_room import CAMERA, GRID, ROOM
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, RGBD, intersect, march, render, world_rays
from vssm_gym.model.emission_uncertainty import MeasurementNoise, image_std, sample_images, sample_map

VIEW = Camera.from_hfov(16, 12, np.radians(60))
WALL = Room(interior=((-2.0, -4.0, -4.0), (1.53, 4.0, 4.0)))


def wall(count: float) -> VoxelMap:
    """Return a room whose wall at x = 1.53 was observed ``count`` times by every cell."""
    m = WALL.to_map((-0.5, -1.6, -1.2), 0.07, (40, 48, 40))
    full = lambda a: jnp.full_like(a, count)
    return eqx.tree_at(
        lambda m: (m.occupancy_precision, m.colour_precision),
        m,
        (full(m.occupancy_precision), full(m.colour_precision)),
    )


def pose(yaw: float = 0.0, pitch: float = 0.0) -> jax.Array:
    return jnp.asarray(camera_pose((0.1, 0.05, 0.1), yaw, pitch), jnp.float32)


@pytest.fixture(scope="module")
def seen() -> VoxelMap:
    """Return a room mapped from two images: observed in part, as real maps are."""
    m = VoxelMap.prior(*GRID)
    for yaw in (0.0, 0.4):
        T = camera_pose((-1.0, 0.0, 1.0), yaw)
        image = ROOM.image(T, CAMERA)
        m = update(m, image.depth, image.rgb, jnp.asarray(T, jnp.float32), CAMERA)
    return m


@pytest.mark.parametrize(
    ("count", "yaw", "pitch", "low", "high"),
    [(100.0, 0.0, 0.0, 0.93, 1.07), (100.0, 0.25, 0.2, 0.93, 1.07), (9.0, 0.25, 0.2, 0.75, 1.1)],
)
def test_propagation_agrees_with_sampled_maps(count: float, yaw: float, pitch: float, low: float, high: float) -> None:
    """Mean variances over pixels, in 200 sampled maps of a wall, equal the propagated ones, straight on and aslant.

    Cells of 7 cm known to 3 mm are linear to a few percent; known to 1 cm, the crossing moves through cells of other
    weights, and propagation says a fifth too much.
    """
    m, T = wall(count), pose(yaw, pitch)
    image = render(m, T, VIEW)
    depth_std, rgb_std = image_std(m, T, VIEW, image)
    drawn = sample_images(jax.random.key(0), m, T, VIEW, samples=200)
    known = np.asarray(image.known)
    assert known.mean() > 0.9
    for std, samples in ((depth_std, drawn.depth), (rgb_std, drawn.rgb)):
        propagated = np.mean(np.asarray(std, float)[known] ** 2)
        sampled = np.mean(np.var(np.asarray(samples, float), axis=0)[known])
        assert low < sampled / propagated < high
    spread = np.asarray(drawn.depth, float)[:, known] - np.asarray(image.depth, float)[known]
    assert abs(spread.mean()) < 0.002  # first crossing of a noisy field: hardly nearer than the mean's


def test_depth_std_is_the_renderers_own_sensitivity() -> None:
    """``sum (dd/do_i)^2 var_i`` over all cells of the grid, by reverse differentiation of the intersection."""
    m, T = wall(9.0), pose(0.3, 0.1)
    image = render(m, T, VIEW)
    centre, directions = world_rays(T, VIEW)
    k, _ = march(m, centre, directions, MAX_DEPTH)
    variance = MeasurementNoise().occupancy_variance(m.occupancy, m.occupancy_precision, m.voxel_size)

    @jax.jit
    def exact(ray):
        def depth(occupancy):
            changed = eqx.tree_at(lambda m: m.occupancy, m, occupancy)
            return intersect(changed, centre, directions[ray][None], k[ray][None])[0]

        return jnp.sqrt(jnp.sum(jax.grad(depth)(m.occupancy) ** 2 * variance))

    std = np.asarray(image_std(m, T, VIEW, image)[0]).reshape(-1)
    rays = np.arange(0, std.size, 7)
    np.testing.assert_allclose(std[rays], [float(exact(r)) for r in rays], rtol=2e-3)


def test_a_wall_by_hand() -> None:
    """Nine measurements with std 3 cm: in depth 1 cm at a cell's centre, 1 / sqrt(8) cm between eight cells."""
    m, T = wall(9.0), pose()
    std = np.asarray(image_std(m, T, VIEW, render(m, T, VIEW))[0])
    assert 0.01 / np.sqrt(8) - 1e-4 < std.min() < std.max() < 0.01 + 1e-4


def test_more_measurements_reduce_the_uncertainty() -> None:
    T = pose()
    once, often = (image_std(m, T, VIEW, render(m, T, VIEW)) for m in (wall(1.0), wall(16.0)))
    np.testing.assert_allclose(np.asarray(once[0]) / np.asarray(often[0]), 4.0, rtol=1e-4)
    np.testing.assert_allclose(np.asarray(once[1]) / np.asarray(often[1]), 4.0, rtol=1e-3)


def test_the_measurement_noise_scales_the_image() -> None:
    m, T = wall(4.0), pose()
    image = render(m, T, VIEW)
    standard, doubled = (image_std(m, T, VIEW, image, r)[0] for r in (MeasurementNoise(), MeasurementNoise(depth=0.06)))
    np.testing.assert_allclose(np.asarray(doubled), 2.0 * np.asarray(standard), rtol=1e-5)


def test_unobserved_pixels_have_no_finite_std(seen: VoxelMap) -> None:
    T = jnp.asarray(camera_pose((-1.0, 0.0, 1.0), 0.9), jnp.float32)
    image = render(seen, T, CAMERA)
    depth_std, rgb_std = image_std(seen, T, CAMERA, image)
    known = np.asarray(image.known)
    assert 0.1 < known.mean() < 0.95
    for std in (np.asarray(depth_std), np.asarray(rgb_std)):
        assert np.isinf(std[~known]).all()
        assert np.isfinite(std[known]).all()
        assert (std[known] >= 0.0).all()


def test_sampled_maps_keep_unobserved_cells_and_the_bounds(seen: VoxelMap) -> None:
    drawn = sample_map(jax.random.key(1), seen)
    before, after = np.asarray(seen.occupancy), np.asarray(drawn.occupancy)
    observed = np.asarray(seen.occupancy_precision) > OBSERVED_PRECISION
    bound = np.abs(before) >= 2.0 * float(seen.voxel_size) * (1 - 1e-4)
    np.testing.assert_array_equal(after[~observed | bound], before[~observed | bound])
    moved = observed & ~bound
    assert moved.sum() > 1000
    z = (after - before)[moved] * np.sqrt(np.asarray(seen.occupancy_precision)[moved]) / 0.03
    assert abs(z.mean()) < 0.1
    assert abs(z.std() - 1.0) < 0.02


def test_sampled_maps_are_searched_by_their_own_index(seen: VoxelMap) -> None:
    """With a stale index rays would skip surfaces of the sample; the fixed march skips nothing."""
    drawn = sample_map(jax.random.key(2), seen)
    T = jnp.asarray(camera_pose((-1.0, 0.0, 1.0), 0.2), jnp.float32)
    image = render(drawn, T, CAMERA)
    centre, directions = world_rays(T, CAMERA)
    k, hit = march(drawn, centre, directions, MAX_DEPTH)
    depth = np.where(hit, np.asarray(intersect(drawn, centre, directions, jnp.where(hit, k, 2))), 0.0)
    assert np.mean(np.abs(depth - np.asarray(image.depth).reshape(-1)) > 1e-3) < 1e-3


def test_samples_are_repeatable_and_differ(seen: VoxelMap) -> None:
    T = jnp.asarray(camera_pose((-1.0, 0.0, 1.0), 0.2), jnp.float32)
    first, again = (sample_images(jax.random.key(3), seen, T, CAMERA, samples=3) for _ in range(2))
    assert isinstance(first, RGBD)
    assert first.depth.shape == (3, CAMERA.height, CAMERA.width)
    np.testing.assert_array_equal(np.asarray(first.depth), np.asarray(again.depth))
    assert (np.asarray(first.depth[0]) != np.asarray(first.depth[1])).mean() > 0.5
