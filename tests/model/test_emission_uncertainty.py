"""Test map uncertainty in images: propagation against sampled maps, by hand, and laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.localisation_room import CAMERA, GRID, ROOM
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD, render, world_rays
from vssm_gym.model.emission_uncertainty import image_std, sample_images
from vssm_gym.model.map_samples import MeasurementNoise

VIEW = Camera.from_hfov(16, 12, np.radians(60))
READING = 0.006  # m, std of one reading
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


@pytest.mark.slow
@pytest.mark.parametrize(("count", "yaw", "pitch"), [(9.0, 0.25, 0.2), (100.0, 0.0, 0.0)])
def test_propagation_agrees_with_sampled_maps(count: float, yaw: float, pitch: float) -> None:
    """Mean variances over pixels, in 40 sampled maps of a wall, equal the propagated ones, straight on and aslant."""
    m, T = wall(count), pose(yaw, pitch)
    image = render(m, T, VIEW)
    depth_std, rgb_std = image_std(m, T, VIEW, image)
    drawn = sample_images(jax.random.key(0), m, T, VIEW, samples=40)
    known = np.asarray(image.known)
    assert known.mean() > 0.9
    for std, samples in ((depth_std, drawn.depth), (rgb_std, drawn.rgb)):
        propagated = np.mean(np.asarray(std, float)[known] ** 2)
        sampled = np.mean(np.var(np.asarray(samples, float), axis=0)[known])
        assert 0.7 < sampled / propagated < 1.4  # pixels of a sample vary together: some 25 % of chance
    spread = np.asarray(drawn.depth, float)[:, known] - np.asarray(image.depth, float)[known]
    assert abs(spread.mean()) < 0.002


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (0.5, 0.0), (0.3, 0.15)])
def test_depth_std_is_the_surfaces_along_the_ray(yaw: float, pitch: float) -> None:
    """A wall whose normal is x: the std along a ray with direction ``r`` a metre of depth is ``std / r_x``."""
    m, T = wall(9.0), pose(yaw, pitch)
    image = render(m, T, VIEW)
    _, directions = world_rays(T, VIEW)
    expected = np.hypot(READING / 3.0, 0.02 * 0.07) / np.asarray(directions, float)[:, 0]
    std = np.asarray(image_std(m, T, VIEW, image)[0], float).reshape(-1)
    known = np.asarray(image.known).reshape(-1)
    assert known.mean() > 0.7
    np.testing.assert_allclose(std[known], expected[known], rtol=5e-3)


def test_depth_std_is_the_derivative_of_the_renderer() -> None:
    """A map that is displaced by one std along the wall's normal is seen that much farther."""
    m, T = wall(9.0), pose(0.3, 0.1)
    image, e = render(m, T, VIEW), float(np.hypot(READING / 3.0, 0.02 * 0.07))
    moved = render(eqx.tree_at(lambda m: m.origin, m, m.origin + jnp.array([e, 0.0, 0.0])), T, VIEW)
    known = np.asarray(image.known & moved.known)
    change = np.asarray(moved.depth - image.depth, float)
    np.testing.assert_allclose(np.asarray(image_std(m, T, VIEW, image)[0])[known], change[known], rtol=0.02)


def test_a_ray_that_grazes_magnifies_tenfold_at_most() -> None:
    m, T = wall(9.0), jnp.asarray(camera_pose((1.45, -0.9, 0.1), 1.52), jnp.float32)
    image = render(m, T, VIEW)
    hit = np.asarray(image.known)
    assert hit.any()
    std = np.asarray(image_std(m, T, VIEW, image)[0])[hit]
    assert std.max() <= 10.0 * np.hypot(READING / 3.0, 0.02 * 0.07) * 1.001


def test_readings_reduce_their_part_of_the_uncertainty() -> None:
    """``var = s^2 / n + (a h)^2``: what a hundred readings leave is the part of the cells."""
    T = pose()
    for count in (1.0, 16.0, 1e4):
        m = wall(count)
        depth, rgb = image_std(m, T, VIEW, render(m, T, VIEW))
        np.testing.assert_allclose(np.asarray(depth).min(), np.sqrt(READING**2 / count + 0.0014**2), rtol=1e-3)
        assert np.asarray(rgb).min() == pytest.approx(0.1 / np.sqrt(count), rel=0.05)


def test_the_measurement_noise_scales_the_image() -> None:
    m, T = wall(4.0), pose()
    image = render(m, T, VIEW)
    std = image_std(m, T, VIEW, image, MeasurementNoise(depth=0.06))[0]
    np.testing.assert_allclose(np.asarray(std).min(), np.hypot(0.03, 0.0014), rtol=1e-3)


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


@pytest.mark.slow
def test_samples_are_repeatable_and_differ(seen: VoxelMap) -> None:
    T = jnp.asarray(camera_pose((-1.0, 0.0, 1.0), 0.2), jnp.float32)
    first, again = (sample_images(jax.random.key(3), seen, T, CAMERA, samples=3) for _ in range(2))
    assert isinstance(first, RGBD)
    assert first.depth.shape == (3, CAMERA.height, CAMERA.width)
    np.testing.assert_array_equal(np.asarray(first.depth), np.asarray(again.depth))
    assert (np.asarray(first.depth[0]) != np.asarray(first.depth[1])).mean() > 0.5
