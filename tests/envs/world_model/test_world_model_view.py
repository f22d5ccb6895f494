"""Test the views of imagined robots against the emission, in the plane and in images, and their collisions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from tests.helpers.imagined_room import CUPBOARD, FLOOR, TABLE, half_seen, room
from tests.helpers.random_maps import KINDS, random_map
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.world_model.collision_map import CollisionMap, slide
from vssm_gym.envs.world_model.rays import RayField, rays_of, surface
from vssm_gym.envs.world_model.scan_table import ScanTable, scan_depths
from vssm_gym.envs.world_model.view import ImaginedCamera
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.scan import scan_of
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission

T_BODY_CAM = HolonomicRobot().T_body_cam
POSES = np.array([[1.0, 1.5, 0.0], [1.0, 1.0, 2.0], [3.0, 1.0, -0.7], [4.5, 2.5, 3.1], [0.5, 0.4, -2.4]])


def emitted(m: VoxelMap, pose: np.ndarray, camera: Camera) -> emission.RGBD:
    T_world_cam = planar_to_matrix(np.asarray(pose, np.float64)) @ T_BODY_CAM
    return emission.render(m, jnp.asarray(T_world_cam, jnp.float32), camera)


@pytest.mark.slow
def test_a_scan_is_the_horizontal_row_of_the_emission():
    camera = Camera.from_hfov(64, 1, np.pi / 2)
    view = ImaginedCamera.scan([room()], camera, T_BODY_CAM, 8.0)
    seen = np.asarray(view(jnp.zeros(len(POSES), jnp.int32), jnp.asarray(POSES, jnp.float32))["scan"])
    for pose, scan in zip(POSES, seen, strict=True):
        off = np.abs(scan - np.asarray(emitted(room(), pose, camera).depth)[0])
        assert np.median(off) < 1e-3 and off.max() < 0.5 * float(room().voxel_size)
    assert (seen > 0.0).mean() > 0.95


def test_an_image_is_the_emissions_in_depth_and_colour():
    camera = Camera.from_hfov(32, 24, np.pi / 2)
    view = ImaginedCamera.images([room()], camera, T_BODY_CAM, 8.0, colour=True)
    seen = view(jnp.zeros(len(POSES), jnp.int32), jnp.asarray(POSES, jnp.float32))
    for pose, depth, rgb in zip(POSES, np.asarray(seen["depth"]), np.asarray(seen["rgb"]), strict=True):
        expected = emitted(room(), pose, camera)
        same = np.abs(depth - np.asarray(expected.depth)) < 2e-3
        assert same.mean() > 0.998  # where a sample meets the threshold to the last bits they may differ by one
        np.testing.assert_allclose(rgb[same] / 255.0, np.asarray(expected.rgb)[same], atol=0.01)


def plane_of(kind: str, seed: int) -> tuple[VoxelMap, RayField, float]:
    """Return a random map, its layer with the most surfaces as a field, and that layer's height."""
    m = random_map(kind, seed)
    nx, ny, nz = m.shape
    above = np.asarray(m.dense(m.occupancy)).reshape(nx, ny, nz) > 0.0
    layer = int(np.argmax([(above[:, :, z] ^ np.roll(above[:, :, z], 1, axis=0)).sum() for z in range(nz)]))
    low = np.asarray(m.origin)
    height = float(low[2] + layer * float(m.voxel_size))
    occupancy = np.asarray(m.dense(m.occupancy)).reshape(nx, ny, nz)[:, :, layer]
    return m, RayField.cut(occupancy[None], low[:2], float(m.voxel_size), 4), height


def rays_from_everywhere(m: VoxelMap, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw centres, directions and angles of rays, world frame."""
    low, high = m.bounds
    rng = np.random.default_rng(0)
    centre = rng.uniform(low[:2] + 0.1, high[:2] - 0.1, (n, 2)).astype(np.float32)
    angle = rng.uniform(-np.pi, np.pi, n).astype(np.float32)
    return centre, np.stack([np.cos(angle), np.sin(angle)], -1), angle


@jax.jit
def traced(field: RayField, centre: tuple, direction: tuple, max_depth: float) -> jax.Array:
    """Return depths of rays one by one, without a table."""
    which = jnp.zeros(centre[0].shape, jnp.int32)
    return emission.STEP * field.voxel_size * surface(field, *rays_of(field, which, centre, direction, max_depth))


@jax.jit
def marched(m: VoxelMap, centre: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return depths up to 4 m by the published march, 0 for none, and the samples that hit; each ray has its centre."""

    def one(at, towards):
        k, hit = emission.march(m, at, towards[None], 4.0)
        return jnp.where(hit[0], emission.intersect(m, at, towards[None], k)[0], 0.0), jnp.where(hit[0], k[0], 0)

    return jax.vmap(one)(centre, direction)


SURFACES = [kind for kind in KINDS if kind not in ("empty", "solid")]  # more than nothing and everything


@pytest.mark.parametrize("kind", KINDS)
def test_no_surface_is_skipped_in_any_map(kind):
    """Rays from everywhere in random fields agree with the published march of the same plane."""
    n, later = 512, 0
    for seed in range(4):
        m, field, height = plane_of(kind, seed)
        centre, direction, _ = rays_from_everywhere(m, n)
        found = np.asarray(traced(field, tuple(centre.T), tuple(direction.T), 4.0))
        flat = np.zeros((n, 1), np.float32)
        whole = (np.hstack([centre, flat + height]), np.hstack([direction, flat]))
        depth, k = marched(m, *(jnp.asarray(a, jnp.float32) for a in whole))
        # A sample that meets the threshold to the last bit may count as above or below.
        assert (np.abs(found - np.asarray(depth)) < 5e-3).mean() > 0.995, seed
        later += int((np.asarray(k) > 4).sum())
    assert later > 0.03 * 4 * n or kind not in SURFACES


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_surface_is_skipped_in_any_image(kind):
    """Blocks of pixels advance together: from inside and outside the map, at sizes that are no multiple of a block."""
    camera, T_body_cam = Camera.from_hfov(30, 22, np.pi / 2), T_BODY_CAM.copy()
    T_body_cam[2, 3] = 1.1  # in the middle of these maps
    poses = np.array([[0.0, 0.0, 0.3], [-0.8, 0.5, -1.2], [-2.6, -0.9, 0.4], [0.1, 3.4, -1.6], [1.0, -0.8, 2.2]])
    seen_from_afar = 0
    for seed in range(3):
        m = random_map(kind, seed)
        view = ImaginedCamera.images([m], camera, T_body_cam, 4.0, colour=False)
        seen = view(jnp.zeros(len(poses), jnp.int32), jnp.asarray(poses, jnp.float32))["depth"]
        for pose, depth in zip(poses, np.asarray(seen), strict=True):
            T_world_cam = jnp.asarray(planar_to_matrix(pose) @ T_body_cam, jnp.float32)
            expected = np.asarray(emission.render_with(emission.march, m, T_world_cam, camera, 4.0).depth)
            assert (np.abs(depth - expected) < 5e-3).mean() > 0.99, (seed, pose)
            seen_from_afar += int((expected > 0.3).sum())
    assert seen_from_afar > 50 or kind not in SURFACES


def test_column_bounds_pass_no_surface_and_reach_nearly_all_of_them():
    """In two maps at once, a column's bound ends before the hit, mostly within a cell of it."""
    camera, one = Camera.from_hfov(64, 48, np.pi / 2), room()
    thinner = eqx.tree_at(lambda m: m.occupancy, one, one.occupancy - 0.01)
    view = ImaginedCamera.images([one, thinner], camera, T_BODY_CAM, 8.0, colour=False)
    which = jnp.repeat(jnp.arange(2), len(POSES))
    cameras = view._cameras(jnp.asarray(np.tile(POSES, (2, 1)), jnp.float32))
    n, columns = len(which), camera.width
    lines = view._rays(
        jnp.repeat(which, columns),
        [jnp.repeat(a, columns) for a in cameras],
        jnp.tile(view.across, n),
        jnp.zeros(n * columns),
    )
    free = np.asarray(view.column_bounds.first_samples(view.field, *lines, view.down)).reshape(-1)
    met = np.asarray(surface(view.field, *view._rays(view._each(which), *view._pixels(cameras))))
    hit = met > 0.0
    assert hit.mean() > 0.5 and np.asarray(view._each(which))[hit].max() == 1
    assert (free[hit] <= np.floor(met[hit]) + 1.0).all()  # of the sample that hit, or one more
    assert (free[hit] > met[hit] - 1.5 / emission.STEP).mean() > 0.7


@pytest.mark.parametrize("kind", KINDS)
def test_the_scan_table_gives_the_depths_of_traced_rays(kind):
    """Nearly all depths agree to half a cell, fewer in noise fields, whose surfaces are a cell large."""
    n = 4096
    for seed in range(2):
        m, field, _ = plane_of(kind, seed)
        centre, direction, angle = (jnp.asarray(a) for a in rays_from_everywhere(m, n))
        rays = tuple(centre.T), tuple(direction.T)
        looked_up = scan_depths(field, ScanTable.of(field), jnp.zeros(n, jnp.int32), *rays, angle, 4.0)
        off = np.abs(np.asarray(looked_up) - np.asarray(traced(field, *rays, 4.0)))
        assert (off > 0.5 * float(m.voxel_size)).mean() < (0.035 if kind == "noise" else 0.012), seed
        assert np.median(off) < 1e-3, seed


def test_a_ray_outside_and_parallel_to_the_field_ends():
    """Its last sample is at minus infinity, which float32 cannot count from."""
    _, field, _ = plane_of("distance", 0)
    outside = (jnp.array([float(field.origin[0]) - 5.0]), jnp.array([float(field.origin[1]) - 5.0]))
    along = (jnp.array([1.0]), jnp.array([0.0]))
    which = jnp.zeros(1, jnp.int32)
    assert float(traced(field, outside, along, 100.0)[0]) == 0.0
    assert float(scan_depths(field, ScanTable.of(field), which, outside, along, jnp.zeros(1), 100.0)[0]) == 0.0


def test_clearance_is_the_distance_to_obstacles_at_the_robots_height():
    collision_map = CollisionMap.of([room()], 0.5, "blocked")
    solid = shapely.union_all([CUPBOARD, TABLE, FLOOR.buffer(1.0) - FLOOR])
    xy = np.random.default_rng(1).uniform([0.2, 0.2], [4.8, 2.8], (200, 2))
    away = shapely.distance(solid, shapely.points(xy))
    xy, away = xy[away > 0.02], away[away > 0.02]
    x, y = (jnp.asarray(xy[:, a], jnp.float32) for a in (0, 1))
    found, _, _ = collision_map.at(jnp.zeros(len(xy), jnp.int32), x, y)
    np.testing.assert_allclose(np.asarray(found), away, atol=0.02)


def test_a_disc_slides_along_a_wall_without_friction():
    """Pushed at 45 degrees into the wall y = 3, the disc moves by the component along the wall."""
    collision_map = CollisionMap.of([room()], 0.5, "blocked")
    x, y = jnp.array([1.0, 1.0]), jnp.array([2.88, 1.0])
    push = 0.1 * jnp.ones(2)
    x1, y1, collided = slide(collision_map, jnp.zeros(2, jnp.int32), x, y, push, push, 0.1)
    assert collided.tolist() == [True, False]
    np.testing.assert_allclose(np.asarray(x1), [1.1, 1.1], atol=3e-3)
    np.testing.assert_allclose(np.asarray(y1), [2.9, 1.1], atol=1e-2)


@pytest.mark.parametrize("unknown", ["blocked", "free"])
def test_unknown_space_is_blocked_or_free(unknown):
    collision_map = CollisionMap.of([half_seen()], 0.5, unknown)
    x, y = jnp.array([3.7]), jnp.array([1.6])  # nothing was observed here
    clearance, _, _ = collision_map.at(jnp.zeros(1, jnp.int32), x, y)
    assert not bool(collision_map.known_at(x, y)[0])
    assert (float(clearance[0]) > 0.1) == (unknown == "free")


def test_scans_of_depth_images():
    depth = np.zeros((2, 4, 128), np.float32)
    depth[0, 1], depth[0, 2] = 2.0, 1.5  # the nearer of the two rows beside the horizon
    depth[1, 1] = np.linspace(1.0, 9.0, 128)
    scans = scan_of(depth)
    assert scans.shape == (2, 64) and (scans[0] == 1.5).all()
    np.testing.assert_allclose(scans[1, 0], depth[1, 1, 0], atol=0.07)
    assert scans[1, -1] == 0.0  # beyond 8 m
