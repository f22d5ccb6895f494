"""Test the surface mesh: on the field's zero, facing free space, only where observed; and its file."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from skimage.measure import marching_cubes

from tests.helpers.analytic_room import Room, camera_pose, cell_centres
from tests.helpers.field_oracle import FieldOracle
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, transform
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz.mesh import surface_mesh, write_ply

VOXEL = 0.1
CENTRE, RADIUS = np.array([1.03, -2.02, 0.71]), 0.63


def observed(m: VoxelMap, occupancy: np.ndarray, colour: np.ndarray | None = None) -> VoxelMap:
    """Return the map with these cells (nx, ny, nz), all of them observed four times."""
    m = m.with_occupancy(m.blocked(jnp.asarray(occupancy, jnp.float32)))
    cells = m.colour if colour is None else m.blocked(jnp.asarray(colour, jnp.float32))
    seen = jnp.full_like(m.occupancy_precision, 4.0)
    return eqx.tree_at(lambda m: (m.occupancy_precision, m.colour_precision, m.colour), m, (seen, seen, cells))


def ball(shape: tuple[int, int, int] = (24, 24, 24)) -> VoxelMap:
    """Return a ball coloured by position."""
    m = VoxelMap.prior(CENTRE - 0.5 * VOXEL * (np.array(shape) - 1) + 0.013, VOXEL, shape)
    p = cell_centres(m)
    return observed(m, RADIUS - np.linalg.norm(p - CENTRE, axis=-1), 0.5 + 0.3 * (p - CENTRE))


@pytest.fixture(scope="module")
def ball_map() -> VoxelMap:
    return ball()


def test_a_ball_has_its_place_and_volume(ball_map):
    """The mesh is closed, with outward faces: the volume of an inside-out mesh is negative."""
    mesh = surface_mesh(ball_map)
    off = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS
    assert np.abs(off).max() < 0.03 * VOXEL  # the distance to a ball is not linear along an edge, hence not exact
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=0.02)


def test_vertices_hold_the_beliefs_colour_and_variance(ball_map):
    mesh = surface_mesh(ball_map)
    expected = 255.0 * (0.5 + 0.3 * (mesh.vertices - CENTRE))
    assert np.abs(mesh.colours - expected).max() <= 0.51
    np.testing.assert_allclose(mesh.variance, 0.25, rtol=1e-5)


@pytest.mark.parametrize(("seed", "smoothing"), [(0, 0), (1, 1), (2, 2), (3, 0)])
def test_vertices_lie_on_the_zero_of_any_field(seed, smoothing):
    """They lie exactly on an edge of the grid; the few in the middle of an ambiguous cube lie inside it."""
    cells = np.random.default_rng(seed).normal(size=(8, 16, 8))
    for _ in range(smoothing):
        cells = (cells + sum(np.roll(cells, d, axis) for axis in range(3) for d in (-1, 1))) / 7.0
    m = observed(VoxelMap.prior([0.4, -1.0, 2.0], VOXEL, (8, 16, 8)), cells)
    mesh = surface_mesh(m)
    vertices = np.clip(mesh.vertices.astype(float), *m.bounds)  # float32 may put one just outside the grid
    grid = (vertices - m.bounds[0]) / VOXEL
    on_edge = (np.abs(grid - np.round(grid)) < 1e-4).sum(axis=1) >= 2
    assert on_edge.mean() > 0.9
    steepest = max(np.abs(np.diff(cells, axis=axis)).max() for axis in range(3))
    assert np.abs(FieldOracle.of(m)(vertices)[on_edge, 0]).max() < 1e-4 * steepest
    above = cells > 0.0
    for cube in np.floor(grid[~on_edge]).astype(int):
        corners = above[tuple(slice(i, i + 2) for i in cube)]
        assert corners.any() != corners.all()
    np.testing.assert_allclose(mesh.variance, 0.25, rtol=1e-5)  # on the grid's faces too


def test_faces_point_into_free_space(ball_map):
    mesh = surface_mesh(ball_map)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    step = 0.3 * VOXEL * solid.face_normals
    oracle = FieldOracle.of(ball_map)
    ahead, behind = (oracle(solid.triangles_center + sign * step)[:, 0] for sign in (1.0, -1.0))
    large = solid.area_faces > 1e-3 * VOXEL**2  # a sliver has no well-defined normal
    assert large.mean() > 0.9
    assert (ahead < behind)[large].all()


def test_unobserved_space_is_not_meshed():
    """Behind the wall's band the mean returns to the prior, where marching over all cells finds a second sheet."""
    room = Room(((-3.0, -3.0, -3.0), (2.0, 3.0, 3.0)))
    camera = Camera.from_hfov(80, 60, np.radians(70.0))
    T = camera_pose((0.0, 0.02, 0.03), 0.0)
    image = room.image(T, camera)
    m = update(VoxelMap.cube((0.0, 0.0, 0.0), 6.0, VOXEL), image.depth, image.rgb, jnp.asarray(T, jnp.float32), camera)
    mesh = surface_mesh(m)
    assert len(mesh.vertices) > 100
    np.testing.assert_allclose(mesh.vertices[:, 0], 2.0, atol=1e-3 * VOXEL)  # the observed wall
    everywhere = marching_cubes(np.array(m.dense(m.occupancy)), 0.0)[0] * VOXEL + np.asarray(m.origin)
    assert (everywhere[:, 0] > 2.0 + VOXEL).any()


def test_a_surface_seen_at_a_grazing_angle_has_no_holes():
    """The band behind it is hardly a cell deep, so that few cubes have eight observed cells."""
    room = Room(((-3.0, -3.0, -0.73), (9.0, 3.0, 3.0)))
    camera = Camera.from_hfov(160, 120, np.radians(70.0))
    T = camera_pose((0.0, 0.02, 0.03), 0.0, 0.4)
    T_map_world = camera_pose((0.0, 0.0, 0.0), 0.3, 0.4, 0.2)
    image = room.image(T, camera)
    m = VoxelMap.cube((0.0, 0.0, 0.0), 6.4, VOXEL)
    m = update(m, image.depth, image.rgb, jnp.asarray(T_map_world @ T, jnp.float32), camera)
    mesh = surface_mesh(m)
    p_world = transform(inverse(T_map_world), mesh.vertices.astype(float))
    solid = trimesh.Trimesh(p_world, mesh.faces, process=False)
    strip = (np.abs(solid.triangles_center - [1.5, 0.0, -0.73]) < [0.3, 0.5, 0.03]).all(axis=1)
    assert solid.area_faces[strip].sum() == pytest.approx(0.6, rel=0.05)


def test_a_map_without_surfaces_has_an_empty_mesh(tmp_path):
    mesh = surface_mesh(VoxelMap.prior([0.0, 0.0, 0.0], VOXEL, (8, 8, 8)))
    write_ply(tmp_path / "mesh.ply", mesh)
    assert len(mesh.vertices) == len(mesh.faces) == 0
    assert b"element vertex 0\n" in (tmp_path / "mesh.ply").read_bytes()


def test_the_file_reads_back_in_another_library(ball_map, tmp_path):
    mesh = surface_mesh(ball_map)
    write_ply(tmp_path / "mesh.ply", mesh)
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], mesh.colours)
    stored = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(stored["variance"]), mesh.variance)
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]
