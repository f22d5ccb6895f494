"""What imagined robots see: the emission's own depths, in the plane and in images; and what they collide with."""

import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from imagined_room import CUPBOARD, FLOOR, TABLE, half_seen, room
from random_maps import random_map

from vssm_gym import emission
from vssm_gym.camera import Camera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.world_model.ground import Ground, slide
from vssm_gym.envs.world_model.lines import Lines, scan_depths
from vssm_gym.envs.world_model.rays import RayField, depths
from vssm_gym.envs.world_model.view import View
from vssm_gym.geometry import planar_to_matrix
from vssm_gym.scan import scan_of
from vssm_gym.voxel_map import VoxelMap

T_BODY_CAM = HolonomicRobot().T_body_cam
POSES = np.array([[1.0, 1.5, 0.0], [1.0, 1.0, 2.0], [3.0, 1.0, -0.7], [4.5, 2.5, 3.1], [0.5, 0.4, -2.4]])


def emitted(m: VoxelMap, pose: np.ndarray, camera: Camera) -> emission.RGBD:
    T_world_cam = planar_to_matrix(np.asarray(pose, np.float64)) @ T_BODY_CAM
    return emission.render(m, jnp.asarray(T_world_cam, jnp.float32), camera)


def test_a_scan_is_the_horizontal_row_of_the_emission():
    camera = Camera.from_hfov(64, 1, np.pi / 2)
    view = View.scan([room()], camera, T_BODY_CAM, 8.0)
    seen = np.asarray(view(jnp.zeros(len(POSES), jnp.int32), jnp.asarray(POSES, jnp.float32))["scan"])
    for pose, scan in zip(POSES, seen, strict=True):
        off = np.abs(scan - np.asarray(emitted(room(), pose, camera).depth)[0])
        assert np.median(off) < 1e-3 and off.max() < 0.5 * float(room().voxel_size)
    assert (seen > 0.0).mean() > 0.95


def test_an_image_is_the_emissions_in_depth_and_colour():
    camera = Camera.from_hfov(32, 24, np.pi / 2)
    view = View.images([room()], camera, T_BODY_CAM, 8.0, colour=True)
    seen = view(jnp.zeros(len(POSES), jnp.int32), jnp.asarray(POSES, jnp.float32))
    for pose, depth, rgb in zip(POSES, np.asarray(seen["depth"]), np.asarray(seen["rgb"]), strict=True):
        expected = emitted(room(), pose, camera)
        same = np.abs(depth - np.asarray(expected.depth)) < 2e-3
        assert same.mean() > 0.998  # where a sample meets the threshold to the last bits they may differ by one
        np.testing.assert_allclose(rgb[same] / 255.0, np.asarray(expected.rgb)[same], atol=0.01)


KINDS = ["boxes", "thin", "noise", "sparse", "empty"]


def plane_of(kind: str) -> tuple[VoxelMap, RayField, float]:
    """A random map, its middle plane as a field, and that plane's height."""
    m = random_map(kind, 3)
    low, high = m.bounds
    height = float(0.5 * (low[2] + high[2]))
    nx, ny, _ = m.shape
    x, y = (low[a] + float(m.voxel_size) * np.arange(n) for a, n in ((0, nx), (1, ny)))
    plane = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((nx, ny), height)], axis=-1)
    occupancy = np.asarray(m.occupancy_at(jnp.asarray(plane * (1.0 - 1e-6) + 1e-6 * plane.mean((0, 1)), jnp.float32)))
    return m, RayField.cut(occupancy[None], low[:2], float(m.voxel_size), 4), height


def rays_from_everywhere(m: VoxelMap, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, directions and angles, world frame."""
    low, high = m.bounds
    rng = np.random.default_rng(0)
    centre = rng.uniform(low[:2] + 0.1, high[:2] - 0.1, (n, 2)).astype(np.float32)
    angle = rng.uniform(-np.pi, np.pi, n).astype(np.float32)
    return centre, np.stack([np.cos(angle), np.sin(angle)], -1), angle


@pytest.mark.parametrize("kind", KINDS)
def test_no_surface_is_jumped_in_any_map(kind):
    """Reach certifies: random fields, rays from everywhere, against the published march of the same plane."""
    m, field, height = plane_of(kind)
    n = 256
    centre, direction, _ = rays_from_everywhere(m, n)
    found = np.asarray(depths(field, jnp.zeros(n, jnp.int32), tuple(centre.T), tuple(direction.T), 4.0))
    whole = np.column_stack([direction, np.zeros(n)])
    for i in range(0, n, 64):  # every ray has a centre of its own
        at = np.array([*centre[i], height], np.float32)
        k, hit = emission.march(m, jnp.asarray(at), jnp.asarray(whole[i : i + 1], jnp.float32), 4.0)
        expected = float(emission.intersect(m, jnp.asarray(at), jnp.asarray(whole[i : i + 1], jnp.float32), k)[0])
        assert found[i] == pytest.approx(expected if bool(hit[0]) else 0.0, abs=5e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_lines_say_what_rays_meet(kind):
    """Nearly all depths to half a cell, in fields without flat surfaces as well; the shares are those seen."""
    m, field, _ = plane_of(kind)
    n = 4096
    centre, direction, angle = (jnp.asarray(a) for a in rays_from_everywhere(m, n))
    which, at, towards = jnp.zeros(n, jnp.int32), tuple(centre.T), tuple(direction.T)
    traced = np.asarray(depths(field, which, at, towards, 4.0))
    told = np.asarray(scan_depths(field, Lines.of(field), which, at, towards, angle, 4.0))
    off = np.abs(told - traced)
    assert (off > 0.5 * float(m.voxel_size)).mean() < 0.005
    assert np.median(off) < 1e-3


def test_a_ray_beside_the_field_and_along_it_ends():
    """Its last sample is at minus infinity, from where float32 cannot count."""
    _, field, _ = plane_of("boxes")
    outside = (jnp.array([float(field.origin[0]) - 5.0]), jnp.array([float(field.origin[1]) - 5.0]))
    along = (jnp.array([1.0]), jnp.array([0.0]))
    which = jnp.zeros(1, jnp.int32)
    assert float(depths(field, which, outside, along, 100.0)[0]) == 0.0
    assert float(scan_depths(field, Lines.of(field), which, outside, along, jnp.zeros(1), 100.0)[0]) == 0.0


def test_clearance_is_the_distance_to_what_stands_in_the_robots_height():
    ground = Ground.of([room()], 0.5, "blocked")
    solid = shapely.union_all([CUPBOARD, TABLE, FLOOR.buffer(1.0) - FLOOR])
    xy = np.random.default_rng(1).uniform([0.2, 0.2], [4.8, 2.8], (200, 2))
    away = shapely.distance(solid, shapely.points(xy))
    xy, away = xy[away > 0.02], away[away > 0.02]
    x, y = (jnp.asarray(xy[:, a], jnp.float32) for a in (0, 1))
    found, _, _ = ground.at(jnp.zeros(len(xy), jnp.int32), x, y)
    np.testing.assert_allclose(np.asarray(found), away, atol=0.02)


def test_a_disc_slides_along_a_wall_without_friction():
    """Pushed at 45 degrees into the wall y = 3: the part along it is driven, the rest is not."""
    ground = Ground.of([room()], 0.5, "blocked")
    x, y = jnp.array([1.0, 1.0]), jnp.array([2.88, 1.0])
    push = 0.1 * jnp.ones(2)
    x1, y1, touched = slide(ground, jnp.zeros(2, jnp.int32), x, y, push, push, 0.1)
    assert touched.tolist() == [True, False]
    np.testing.assert_allclose(np.asarray(x1), [1.1, 1.1], atol=3e-3)
    np.testing.assert_allclose(np.asarray(y1), [2.9, 1.1], atol=1e-2)


@pytest.mark.parametrize("unknown", ["blocked", "free"])
def test_unknown_space_blocks_or_lets_pass(unknown):
    ground = Ground.of([half_seen()], 0.5, unknown)
    x, y = jnp.array([3.7]), jnp.array([1.6])  # nothing was observed here
    clearance, _, _ = ground.at(jnp.zeros(1, jnp.int32), x, y)
    assert not bool(ground.known_at(x, y)[0])
    assert (float(clearance[0]) > 0.1) == (unknown == "free")


def test_scans_of_depth_images():
    depth = np.zeros((2, 4, 128), np.float32)
    depth[0, 1], depth[0, 2] = 2.0, 1.5  # the nearer of the two rows beside the horizon
    depth[1, 1] = np.linspace(1.0, 9.0, 128)
    scans = scan_of(depth)
    assert scans.shape == (2, 64) and (scans[0] == 1.5).all()
    np.testing.assert_allclose(scans[1, 0], depth[1, 1, 0], atol=0.07)
    assert scans[1, -1] == 0.0  # beyond 8 m
