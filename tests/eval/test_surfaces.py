"""Test which surfaces are visible, and the distances of a map from them, on boxes with distances known by hand."""

import numpy as np
import pytest
from trimesh.triangles import closest_point

from tests.helpers.box_maps import map_of, signed_distance
from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.envs.tasks.scene_cache import SceneCache
from vssm_gym.eval.metrics import surfaces
from vssm_gym.eval.metrics.surfaces import Surface, completeness, distance_to_mesh, mesh_quality, observable_surface
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz.mesh import surface_mesh

WALL = SolidBox("wall", "wall", (1.0, 0.0, 1.0), (0.2, 2.0, 2.0), 0.0, Material())  # x from 0.9 to 1.1
CRATE = SolidBox("crate", "furniture", (0.0, 0.0, 0.6), (0.6, 0.4, 0.8), 0.4, Material())


@pytest.fixture(scope="module")
def cache():
    cabinet = furniture("cabinet", (2.675, 3.65, 1.0), (0.55, 0.6, 2.0))  # in the corner of the west room
    shut = two_rooms(openness=0.0, leaves=1, pieces=(cabinet,))
    return SceneCache.of(SharedRenderer.of(shut, CameraConfig(), "raycast"), HolonomicRobot())


@pytest.fixture(scope="module")
def seen(cache):
    return observable_surface(cache)


def test_visible_points_lie_on_faces_with_outward_normals(cache, seen):
    boxes = cache.renderer.boxes
    to_boxes = [np.array([signed_distance(box, seen.points + s * seen.normals) for box in boxes]) for s in (0.0, 0.002)]
    assert np.abs(to_boxes[0]).min(axis=0).max() < 1e-5
    outside = to_boxes[1].min(axis=0) > 0.0
    assert outside.mean() > 0.995  # a point on an edge may look along the other face
    np.testing.assert_allclose(np.linalg.norm(seen.normals, axis=1), 1.0)


def test_surfaces_that_the_robots_camera_cannot_see_are_not_scored(seen):
    x, y, z = seen.points.T
    west = np.ptp(x) < 3.3 and (x.max() < 3.05 or x.min() > 2.95)
    assert west  # the door is shut: one room only
    behind = (x > 2.45) & (x < 2.9) & (y > 3.4) & (y < 3.9) & (z > 0.05) & (z < 1.95)
    assert not behind.any()  # the cabinet stands against both walls
    assert (seen.normals[:, 2][np.abs(z) < 1e-6] > 0.99).all()  # of the floor its upper side


def test_the_floor_has_about_a_point_every_ten_centimetres(seen):
    floor = seen.points[(np.abs(seen.points[:, 2]) < 1e-6)]
    area = 2.9 * 3.9  # but for the walls; one of the rooms has a cabinet
    assert 0.9 * area / 0.01 < len(floor) < 1.25 * area / 0.01  # cells that a face cuts count as whole ones


def test_the_surface_is_deterministic(cache, seen):
    np.testing.assert_array_equal(observable_surface(cache).points, seen.points)
    some = seen.thinned(100)
    assert len(some.points) == 100
    np.testing.assert_array_equal(some.points, seen.thinned(100).points)
    assert seen.thinned(10**9) is seen


def front_of_wall(n=7):
    y, z = (g.ravel() for g in np.meshgrid(np.linspace(-0.8, 0.8, n), np.linspace(0.3, 1.7, n)))
    points = np.stack([np.full_like(y, 0.9), y, z], axis=-1)
    return Surface(points, np.broadcast_to([-1.0, 0.0, 0.0], points.shape).copy())


@pytest.mark.parametrize(("shift", "share"), [(0.0, 1.0), (0.08, 1.0), (-0.08, 1.0), (0.13, 0.0), (-0.13, 0.0)])
def test_a_surface_is_found_within_ten_centimetres_along_its_normal(shift, share):
    assert completeness(map_of([WALL], shift), front_of_wall()) == share


def test_neither_unobserved_cells_nor_the_back_of_a_thin_wall_are_a_surface():
    front = front_of_wall()
    assert completeness(map_of([WALL], observed=False), front) == 0.0
    assert completeness(VoxelMap.prior(np.zeros(3), 0.05, (32, 32, 32)), front) == 0.0
    wrong_way = Surface(front.points, -front.normals)
    assert completeness(map_of([WALL]), wrong_way) == 0.0


@pytest.mark.parametrize("boxes", [[WALL], [CRATE], [WALL, CRATE]])
def test_distances_to_faces_are_those_of_the_boxes(boxes):
    points = np.random.default_rng(0).uniform([-1.0, -1.5, -0.3], [1.7, 1.5, 2.3], (500, 3))
    expected = np.minimum(np.abs([signed_distance(box, points) for box in boxes]).min(axis=0), surfaces.CLIPPED_AT)
    np.testing.assert_allclose(surfaces._Faces.of(boxes).distance(points), expected, atol=1e-12)


def test_distances_to_a_mesh_are_those_to_its_nearest_triangle():
    mesh = surface_mesh(map_of([CRATE]))
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3)) + CRATE.center
    triangles = mesh.vertices[mesh.faces].astype(float)
    each = [
        np.linalg.norm(closest_point(triangles, np.broadcast_to(p, (len(triangles), 3))) - p, axis=1) for p in points
    ]
    expected = np.minimum(np.min(each, axis=1), surfaces.CLIPPED_AT)
    np.testing.assert_allclose(distance_to_mesh(points, mesh), expected, atol=1e-3)


@pytest.mark.parametrize("shift", [0.0, 0.03, 0.07])
def test_a_shifted_map_is_off_by_its_shift_both_ways(shift):
    found = mesh_quality(map_of([WALL], shift), front_of_wall(15), [WALL])
    assert found["completion"] == pytest.approx(shift, abs=2e-3)
    assert found["complete_5cm"] == (shift < 0.05)
    # Of the wall's 2 x 2 x 0.2 m only the two large faces are shifted off themselves: 8 of 9.6 m^2.
    assert found["accuracy"] == pytest.approx(shift * 8.0 / 9.6, abs=4e-3)


def test_an_empty_map_has_no_accuracy_and_no_completion():
    found = mesh_quality(map_of([WALL], observed=False), front_of_wall(), [WALL])
    assert found == {"accuracy": None, "accurate_5cm": None, "completion": surfaces.CLIPPED_AT, "complete_5cm": 0.0}


def test_points_of_a_mesh_are_spread_over_its_area():
    mesh = surface_mesh(map_of([WALL]))
    points = surfaces.sample_mesh(mesh, 4000, 0)
    front = np.mean(np.abs(points[:, 0] - 0.9) < 0.01)
    assert front == pytest.approx(4.0 / 9.6, abs=0.03)
    np.testing.assert_array_equal(points, surfaces.sample_mesh(mesh, 4000, 0))
