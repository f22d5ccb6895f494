"""Test ``vssm-gym map export``: a ROS map read independently, and meshes that other libraries read."""

import json
import struct
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import shapely
import trimesh
import yaml
from PIL import Image

from tests.helpers.planning_worlds import VOXEL, voxel_map
from vssm_gym.errors import InputError
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, write_ros_map
from vssm_gym.viz.glb import linear, write_glb
from vssm_gym.viz.mesh import Mesh, surface_mesh

# Symmetric in nothing, so that a flipped, turned or shifted plan cannot pass.
ROOM = shapely.Polygon([(-1.0, 2.0), (3.13, 2.0), (3.13, 3.57), (1.0, 3.57), (1.0, 5.0), (-1.0, 5.0)])
CUPBOARD = shapely.box(2.3, 2.0, 3.13, 2.5)  # floor to ceiling, in the corner of the highest x and lowest y
TABLE_TOP = shapely.box(-0.6, 4.0, 0.1, 4.6)  # 0.7 m up: over a robot of 0.5 m, not over one of 1 m
STEP = shapely.box(0.2, 2.6, 0.6, 3.0)  # 5 cm high: driven over


@pytest.fixture(scope="module")
def learned() -> VoxelMap:
    return voxel_map(ROOM, [(CUPBOARD, 0.0, 2.5), (TABLE_TOP, 0.7, 0.8), (STEP, 0.0, 0.05)])


def read_ros_map(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read states and cell centres ``(rows, columns[, 2])`` as map_server documents (wiki.ros.org/map_server)."""
    about = yaml.safe_load(path.read_text())
    assert about["mode"] == "trinary"
    image = np.asarray(Image.open(path.parent / about["image"])).astype(float)
    p = image / 255.0 if about["negate"] else (255.0 - image) / 255.0
    states = np.where(p > about["occupied_thresh"], OCCUPIED, np.where(p < about["free_thresh"], FREE, UNKNOWN))
    left, bottom, yaw = about["origin"]
    assert yaw == 0.0
    rows, columns = np.indices(image.shape)
    x = left + (columns + 0.5) * about["resolution"]
    y = bottom + (image.shape[0] - rows - 0.5) * about["resolution"]
    return states, np.stack([x, y], axis=-1)


def distance_inside(polygon: shapely.Polygon, xy: np.ndarray) -> np.ndarray:
    """Return metres to the polygon's border, positive inside."""
    points = shapely.points(xy)
    border = shapely.distance(polygon.exterior, points)
    return np.where(shapely.contains(polygon, points), border, -border)


@pytest.mark.parametrize("resolution", [0.02, 0.05, 0.1, 0.13])
@pytest.mark.parametrize("height", [0.5, 1.0])
def test_the_plan_reads_back_where_it_is_in_the_world(learned, tmp_path, resolution, height):
    """The room is free, its walls and furniture are occupied; borders err by at most a cell and a voxel."""
    write_ros_map(tmp_path / "map.yaml", OccupancyGrid.from_voxel_map(learned, resolution, height))
    states, centres = read_ros_map(tmp_path / "map.yaml")
    free_floor = ROOM.difference(CUPBOARD)
    if height > 0.7:
        free_floor = free_floor.difference(TABLE_TOP)
    room, cupboard = distance_inside(ROOM, centres), distance_inside(CUPBOARD, centres)
    table = distance_inside(TABLE_TOP, centres)
    obstacle = np.maximum(cupboard, table) if height > 0.7 else cupboard
    off = 0.75 * resolution + 0.5 * VOXEL
    clear = (room > off) & (obstacle < -off)
    assert clear.sum() * resolution**2 > 0.5 * free_floor.area
    assert (states[clear] == FREE).all()
    assert (np.minimum(room, -obstacle)[states == FREE] > -0.5 * VOXEL).all()
    # What lies just behind a surface is occupied; deeper inside nothing was ever observed.
    behind = np.maximum(-room, obstacle)
    thin = (behind > 0.05 * VOXEL) & (behind < 0.5 * VOXEL)
    assert thin.any()
    assert (states[thin] == OCCUPIED).mean() > 0.97


def test_a_conservative_plan_grows_with_its_cells(learned):
    """A cell is occupied if any part of it is, so that halving the cells only frees occupied space."""
    fine, coarse = (OccupancyGrid.from_voxel_map(learned, r) for r in (0.025, 0.05))
    x, y = (fine.origin[a] + fine.resolution * (np.arange(fine.cells.shape[a]) + 0.5) for a in (0, 1))
    i = np.floor((x - coarse.origin[0]) / coarse.resolution).astype(int).clip(0, coarse.cells.shape[0] - 1)
    j = np.floor((y - coarse.origin[1]) / coarse.resolution).astype(int).clip(0, coarse.cells.shape[1] - 1)
    assert (coarse.cells[np.ix_(i, j)][fine.cells == OCCUPIED] == OCCUPIED).mean() > 0.99


def test_a_map_of_the_plane_reads_back_where_it_is(tmp_path):
    """Each cell is centred where the map has its corner of the grid; what was never observed around it is cut off."""
    prior = PlanarMap.prior(np.array([-1.3, 2.4]), np.array([1.3, 4.0]), 0.1)
    precision, occupancy = np.asarray(prior.precision).copy(), np.asarray(prior.occupancy).copy()
    precision[3:20, 2:11] = 2.0 * OBSERVED_PRECISION
    occupancy[3:20, 2:11], occupancy[17:20, 2:5] = -0.1, 0.05
    precision[6:8, 7] = np.asarray(prior.precision)[6:8, 7]  # a hole, which only the neighbours' readings surround
    occupancy[0:2] = 0.2  # never observed, so not occupied either
    planar = PlanarMap(jnp.asarray(occupancy), jnp.asarray(precision), prior.origin, prior.cell_size)
    write_ros_map(tmp_path / "map.yaml", OccupancyGrid.from_planar_map(planar))
    states, centres = read_ros_map(tmp_path / "map.yaml")
    assert states.shape == (9, 17)
    i, j = np.rint((centres - np.asarray(prior.origin)) / 0.1).astype(int).transpose(2, 0, 1)
    np.testing.assert_allclose(np.asarray(planar.centres())[i, j], centres, atol=1e-5)
    expected = np.where(occupancy > 0.0, OCCUPIED, FREE)
    expected[~planar.observed] = UNKNOWN
    np.testing.assert_array_equal(states, expected[i, j])
    with pytest.raises(InputError, match="something observed"):
        OccupancyGrid.from_planar_map(prior)


def test_unobserved_space_is_unknown(tmp_path):
    """Half of the room is unobserved; its cells are unknown in the file, and not free for any reader."""
    learned = voxel_map(ROOM, [], lambda x, y, z: np.broadcast_to(x < 0.5, np.broadcast_shapes(x.shape, z.shape)))
    write_ros_map(tmp_path / "map.yaml", OccupancyGrid.from_voxel_map(learned))
    states, centres = read_ros_map(tmp_path / "map.yaml")
    inside = distance_inside(ROOM, centres) > 0.1
    assert (states[inside & (centres[..., 0] < 0.4)] == FREE).all()
    assert centres[..., 0].max() < 0.6  # the plan ends where knowledge does
    learned = voxel_map(ROOM, [], lambda x, y, z: (np.hypot(x - 0.2, y - 3.0) > 0.5) | (z < -1.0))
    write_ros_map(tmp_path / "map.yaml", OccupancyGrid.from_voxel_map(learned))
    states, centres = read_ros_map(tmp_path / "map.yaml")
    from_hole = np.hypot(*(np.moveaxis(centres, -1, 0) - np.array([0.2, 3.0])[:, None, None]))
    assert (states[from_hole < 0.4] == UNKNOWN).all()
    assert not (states[(from_hole > 0.6) & (distance_inside(ROOM, centres) > 0.1)] == UNKNOWN).any()


def test_the_files_by_hand(tmp_path):
    """Two columns and three rows: free, occupied and unknown in map_saver's grey levels, highest y first."""
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [FREE, FREE, OCCUPIED]], np.int8)  # [ix, iy]
    write_ros_map(tmp_path / "plan.yaml", OccupancyGrid(cells, np.array([-1.5, 2.25]), 0.05))
    assert (tmp_path / "plan.pgm").read_bytes() == b"P5\n2 3\n255\n" + bytes([205, 0, 0, 254, 254, 254])
    assert (tmp_path / "plan.yaml").read_text() == (
        "image: plan.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2.25, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


@pytest.mark.parametrize(
    ("arguments", "field"),
    [({"resolution": 0.0}, "resolution"), ({"resolution": float("nan")}, "resolution"), ({"height": 0.05}, "height")],
)
def test_an_impossible_plan_is_refused(learned, arguments, field):
    with pytest.raises(InputError) as refused:
        OccupancyGrid.from_voxel_map(learned, **arguments)
    assert refused.value.field == field


def test_an_empty_map_has_no_plan():
    with pytest.raises(InputError, match=r"something observed between 0\.08 and 0\.5 m"):
        OccupancyGrid.from_voxel_map(VoxelMap.prior([0.0, 0.0, 0.0], 0.1, (8, 8, 8)))


def test_the_glb_reads_back_in_another_library(learned, tmp_path):
    """Triangles are the same, with y up in glTF's frame; linear colours in glTF are ours in sRGB."""
    mesh = surface_mesh(learned)
    write_glb(tmp_path / "mesh.glb", mesh)
    scene = trimesh.load(tmp_path / "mesh.glb", process=False)
    (name,) = scene.geometry
    read = scene.geometry[name]
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    turned = scene.to_mesh().vertices if hasattr(scene, "to_mesh") else scene.dump(concatenate=True).vertices
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(turned, np.stack([x, z, -y], axis=-1), atol=1e-5)
    colours = np.asarray(read.visual.vertex_attributes["color"])
    np.testing.assert_array_equal(colours[:, :3], linear(mesh.colours))


def test_linear_colours_by_hand():
    """Black, white, and 188 in sRGB, which is half of the light, have known linear values."""
    levels = linear(np.array([[0, 188, 255]], np.uint8))[0] / 65535.0
    np.testing.assert_allclose(levels, [0.0, 0.5, 1.0], atol=3e-3)


@pytest.mark.parametrize("faces", [0, 1])
def test_the_glb_follows_the_specification(tmp_path, faces):
    """Header, chunks of whole words and lengths are right; without a triangle there is no buffer."""
    n = 3 * faces
    nothing = Mesh(np.eye(3, dtype=np.float32)[:n], np.arange(n).reshape(-1, 3), np.zeros((n, 3), np.uint8), np.ones(n))
    write_glb(tmp_path / "mesh.glb", nothing)
    data = (tmp_path / "mesh.glb").read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    at, chunks = 12, {}
    while at < len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        assert size % 4 == 0
        chunks[kind] = data[at + 8 : at + 8 + size]
        at += 8 + size
    assert list(chunks) == [b"JSON", b"BIN\0"][: 1 + faces]
    document = json.loads(chunks[b"JSON"])
    assert document["asset"]["version"] == "2.0"
    if faces:
        assert document["buffers"][0]["byteLength"] == len(chunks[b"BIN\0"])
        assert sum(view["byteLength"] for view in document["bufferViews"]) == len(chunks[b"BIN\0"])


def test_the_command_writes_everything_at_once(vssm, learned, tmp_path):
    learned.save(tmp_path / "map.npz")
    code, out, _ = vssm("map", "export", str(tmp_path / "map.npz"), "--out", str(tmp_path / "new" / "export"))
    assert code == 0
    written = sorted(path.name for path in (tmp_path / "new" / "export").iterdir())
    assert written == ["map.pgm", "map.yaml", "mesh.glb", "mesh.ply"]
    assert "cells of 0.05 m" in out
    states, centres = read_ros_map(tmp_path / "new" / "export" / "map.yaml")
    grid = OccupancyGrid.from_voxel_map(learned)
    np.testing.assert_array_equal(states, grid.cells.T[::-1])
    np.testing.assert_allclose(centres[-1, 0], grid.origin + 0.5 * grid.resolution, atol=1e-5)
    again = vssm("map", "export", str(tmp_path / "map.npz"), "--out", str(tmp_path / "new" / "export"))
    assert again[0] == 2
    assert "nothing is ever overwritten" in again[2]


def test_a_map_in_a_cameras_frame_has_no_plan(vssm, learned, tmp_path):
    """A map of `slam` has its z axis ahead, so that a horizontal cut through it is not a floor plan."""
    learned.save(tmp_path / "map.npz", sequence="desk", frames=7)
    code, out, err = vssm("map", "export", str(tmp_path / "map.npz"), "--out", str(tmp_path / "export"))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "a map whose z axis points up" in err
    assert not (tmp_path / "export").exists()


def test_a_missing_map_is_one_line(vssm, tmp_path):
    code, _, err = vssm("map", "export", str(tmp_path / "none.npz"), "--out", str(tmp_path / "export"))
    assert (code, err.count("\n")) == (2, 1)
    assert "none.npz: file: expected an existing map file" in err
