"""Test the surface of a page: decimation, the block that its script reads, and the picture in its place."""

import io
import math
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from vssm_gym.viz import surface_view
from vssm_gym.viz.mesh import Mesh
from vssm_gym.viz.mesh_picture import ELEVATION, PAPER
from vssm_gym.viz.surface_view import camera_segments, decimated, facing, packed, path_segments, prepared


@pytest.fixture(scope="module")
def ball():
    """A sphere of the radius 1 m about (1, 2, 3), red below and blue above, seen from outside."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    colours = np.where(sphere.vertices[:, 2:] < 0.0, [255, 0, 0], [0, 0, 255]).astype(np.uint8)
    vertices = (sphere.vertices + np.array([1.0, 2.0, 3.0])).astype(np.float32)
    return Mesh(vertices, np.asarray(sphere.faces, np.int32), colours, np.ones(len(vertices)))


def volume(mesh):
    """Return the signed volume of a closed surface, positive where its faces are counter-clockwise from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) - [1.0, 2.0, 3.0] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def test_a_decimated_surface_keeps_shape_colours_and_the_side_it_is_seen_from(ball):
    small = decimated(ball, 700)
    assert 200 < len(small.faces) <= 700 < len(ball.faces)
    assert volume(ball) == pytest.approx(4.0 / 3.0 * math.pi, rel=0.01)
    assert volume(small) == pytest.approx(volume(ball), rel=0.08)
    away = np.linalg.norm(small.vertices - [1.0, 2.0, 3.0], axis=1)
    assert away.min() > 0.85 and away.max() <= 1.0 + 1e-5
    assert set(np.unique(small.faces)) == set(range(len(small.vertices)))
    top = small.vertices[:, 2] > 3.3
    assert (small.colours[top] == [0, 0, 255]).all() and len(small.variance) == len(small.vertices)
    assert decimated(ball, len(ball.faces)) is ball


def test_the_block_holds_the_surface_to_half_a_step_and_the_paths(ball):
    path = path_segments(np.stack([np.linspace(0.0, 1.0, 5), np.zeros(5), np.zeros(5)], axis=-1))
    block, _ = prepared(ball, path, path[:2], np.array([0.0, 1.0]))
    vertices, faces, estimate, truth = struct.unpack("<4I", block[:16])
    assert (vertices, faces, estimate, truth) == (len(ball.vertices), len(ball.faces), 4, 2)
    *low, step, _, _, _, radius, turn, rise = struct.unpack("<10f", block[16:56])
    assert (turn, rise) == (pytest.approx(-math.pi / 2), pytest.approx(ELEVATION))  # from the south, which looks north
    assert radius > 1.0
    end = 56 + 8 * vertices
    places = np.frombuffer(block[56:end], "<u2").reshape(-1, 4)[:, :3]
    np.testing.assert_allclose(low + step * places, ball.vertices, atol=0.51 * step + 1e-6)
    colours = np.frombuffer(block[end : end + 4 * vertices], np.uint8).reshape(-1, 4)
    np.testing.assert_array_equal(colours[:, :3], ball.colours)
    end += 4 * vertices
    np.testing.assert_array_equal(np.frombuffer(block[end : end + 12 * faces], "<u4").reshape(-1, 3), ball.faces)
    lines = np.frombuffer(block[end + 12 * faces :], "<f4").reshape(-1, 2, 3)
    np.testing.assert_allclose(lines, np.concatenate([path, path[:2]]), atol=1e-6)


def test_the_still_picture_shows_surface_and_path(ball):
    over = path_segments(np.array([[0.2, 1.2, 4.2], [1.8, 2.8, 4.2]]))
    none = np.zeros((0, 2, 3))
    pixels, bare = (
        np.asarray(Image.open(io.BytesIO(prepared(ball, path, none, None)[1])).convert("RGB")).astype(int)
        for path in (over, over[:0])
    )
    assert pixels.shape[1] == surface_view.STILL_WIDTH
    blue = (pixels[..., 2] > 150) & (pixels[..., 0] < 80)
    line = abs(pixels - bare).max(axis=-1) > 60
    assert blue.mean() > 0.1 and 300 < line.sum() < 20_000
    assert abs(pixels[2, 2] - PAPER).max() < 6


def test_cameras_look_the_way_of_their_poses():
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]  # z of the camera along x
    T[:, 0, 3] = np.linspace(0.0, 4.0, 40)
    np.testing.assert_allclose(facing(T), [1.0, 0.0])
    edges = camera_segments(T, 0.1)
    assert len(edges) == 8 * surface_view.CAMERAS  # at most, 0.3 m apart
    np.testing.assert_allclose(edges[:4, 1, 0], 0.1)
    assert len(camera_segments(T[:3], 0.1)) == 8  # the others stand where the first does
    around = T.copy()
    around[::2, :3, 2] *= -1.0
    assert facing(around) is None


def test_a_page_of_the_largest_surface_stays_small():
    rng = np.random.default_rng(0)
    n = surface_view.MOST_FACES
    faces = rng.integers(0, n // 2, (n, 3)).astype(np.int32)
    mesh = Mesh(rng.random((n // 2, 3)).astype(np.float32), faces, np.zeros((n // 2, 3), np.uint8), np.ones(n // 2))
    lines = path_segments(rng.random((5000, 3)))
    assert len(lines) == surface_view.MOST_POINTS - 1
    view = surface_view.View(np.eye(3), np.zeros(2), 1.0)
    assert 4 / 3 * len(packed(mesh, lines, lines, view)) < 2.5e6  # of base64
