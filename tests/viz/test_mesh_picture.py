"""Test pictures of meshes: drawn sides, occlusion, the cut."""

import numpy as np
import pytest

from vssm_gym.viz.mesh import Mesh
from vssm_gym.viz.mesh_picture import PAPER, mesh_picture

RED, GREEN = (200, 0, 0), (0, 200, 0)


def squares(*parts):
    """Return squares ``(corner, edge, edge, colour)``, seen from the side that ``edge x edge`` points to."""
    vertices, faces, colours = [], [], []
    for corner, a, b, colour in parts:
        c, a, b = (np.asarray(v, float) for v in (corner, a, b))
        n = len(vertices)
        vertices += [c, c + a, c + a + b, c + b]
        faces += [(n, n + 1, n + 2), (n, n + 2, n + 3)]
        colours += [colour] * 4
    return Mesh(
        np.array(vertices, np.float32), np.array(faces, np.int32), np.array(colours, np.uint8), np.zeros(len(vertices))
    )


def share(image, colour):
    """Return the share of drawn pixels that have the hue of ``colour``."""
    shown = (image != PAPER).any(axis=2)
    return float(((image.argmax(axis=2) == int(np.argmax(colour))) & shown).sum() / max(shown.sum(), 1))


FLOOR = ((0, 0, 0), (4, 0, 0), (0, 3, 0), RED)


def area(image):
    return int((image != PAPER).any(axis=2).sum())


def test_a_floor_is_a_parallelogram_in_its_colour():
    image = mesh_picture(squares(FLOOR), 300)
    assert image.shape[1] == 300
    assert share(image, RED) == 1.0
    inside = image[image.shape[0] // 2, 150]
    assert inside[0] > 150
    assert (inside[1:] == 0).all()
    assert (image[0, 0] == PAPER).all()
    # Parallel projection: its area is that of the floor by the sine of the elevation, for every azimuth.
    columns = np.flatnonzero((image != PAPER).any(axis=(0, 2)))
    scale = (columns[-1] - columns[0] + 1) / (4 * np.cos(np.radians(20)) + 3 * np.sin(np.radians(20)))
    assert area(image) == pytest.approx(12 * np.sin(np.radians(52)) * scale**2, rel=0.02)


def test_a_face_is_seen_from_its_front_only():
    ceiling = ((0, 0, 1.0), (0, 3, 0), (4, 0, 0), GREEN)  # free space is below it
    image = mesh_picture(squares(FLOOR, ceiling), 300)
    assert share(image, RED) == 1.0
    top = ((0, 0, 1.0), (4, 0, 0), (0, 3, 0), GREEN)
    assert share(mesh_picture(squares(FLOOR, top), 300), GREEN) > 0.5


@pytest.mark.parametrize("first", [0, 1])
def test_higher_faces_hide_lower_ones_in_any_order(first):
    parts = [FLOOR, ((1, 1, 0.5), (1, 0, 0), (0, 1, 0), GREEN)]
    image = mesh_picture(squares(parts[first], parts[1 - first]), 300)
    assert share(image, GREEN) == pytest.approx(1 / 12, rel=0.05)


def test_the_cut_goes_through_faces():
    near = ((0, 0, 0), (0, 0, 3.0), (4, 0, 0), GREEN)  # its back to the viewer
    far = ((0, 3, 0), (4, 0, 0), (0, 0, 3.0), GREEN)
    assert share(mesh_picture(squares(FLOOR, near), 300), GREEN) == 0.0
    whole, half = (mesh_picture(squares(FLOOR, far), 300, cut) for cut in (10.0, 1.5))
    ratio = lambda image: share(image, GREEN) / share(image, RED)
    assert ratio(half) == pytest.approx(0.5 * ratio(whole), rel=0.05)


def test_nothing_below_the_cut_is_an_empty_picture():
    image = mesh_picture(squares(FLOOR), 300, cut=-1.0)
    assert image.shape == (1, 300, 3)
    assert (image == PAPER).all()
