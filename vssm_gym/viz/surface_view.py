"""Prepare a surface and the paths of a camera for a page: data for the script that turns them, and a still picture.

The script ``templates/surface.js`` reads one little-endian block:

    u32 vertices, faces, segments of the estimate, segments of the truth
    f32 low (3), step, centre (3), radius, turn and rise of the first view (rad)
    u16 places (vertices, 4), u8 colours (vertices, 4), u32 faces (faces, 3), f32 segments (n, 2, 3)

with ``p = low + step * place``. A coordinate is off by half a step at most, 1 / 131070 of the longest edge.
"""

import math
import struct
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from vssm_gym.geometry.transforms import transform
from vssm_gym.viz import pictures
from vssm_gym.viz.mesh import Mesh
from vssm_gym.viz.mesh_picture import View, mesh_view

MOST_FACES = 80_000  # of a page: 12 bytes each, and as many for half as many vertices, before base64
MOST_POINTS = 2_000  # of a path
CAMERAS = 12  # drawn along a path, at most
CAMERA_SIZE = 0.05  # of the radius of the scene
ONE_WAY = 0.3  # length of the mean viewing direction from which on a camera has looked into one direction
STILL_WIDTH = 1400  # pixels

Segments = Float[np.ndarray, "n 2 3"]


def decimated(mesh: Mesh, most: int = MOST_FACES) -> Mesh:
    """Merge vertices in cells of a grid until at most ``most`` faces are left.

    A merged vertex is the mean of those of its cell; faces with two corners in one cell disappear. The grid is
    coarsened by a quarter at a time.
    """
    result = mesh
    edges = np.linalg.norm(mesh.vertices[mesh.faces[:, 0]] - mesh.vertices[mesh.faces[:, 1]], axis=-1)
    size = float(np.median(edges)) if len(edges) else 1.0
    while len(result.faces) > most:
        result, size = _merged(mesh, size), 1.25 * size
    return result


def _merged(mesh: Mesh, size: float) -> Mesh:
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / size).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        columns = values.reshape(len(values), -1).T.astype(float)
        return np.stack([np.bincount(cell, weights=column) / count for column in columns], axis=-1)

    faces = cell[mesh.faces]
    kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)  # least first
    used, faces = np.unique(np.unique(turned[kept], axis=0), return_inverse=True)
    return Mesh(
        mean(mesh.vertices)[used].astype(np.float32),
        faces.reshape(-1, 3).astype(np.int32),
        np.rint(mean(mesh.colours)[used]).astype(np.uint8),
        mean(mesh.variance)[used, 0],
    )


def moved(mesh: Mesh, T: Float[np.ndarray, "4 4"]) -> Mesh:
    """Return the mesh in another frame."""
    return replace(mesh, vertices=transform(T, mesh.vertices.astype(np.float64)).astype(np.float32))


def path_segments(places: Float[np.ndarray, "n 3"]) -> Segments:
    """Return the segments of a path through at most ``MOST_POINTS`` of the places."""
    shown = places[np.unique(np.linspace(0, len(places) - 1, min(len(places), MOST_POINTS)).round().astype(int))]
    return np.stack([shown[:-1], shown[1:]], axis=1)


def camera_segments(T_display_cam: Float[np.ndarray, "n 4 4"], size: float) -> Segments:
    """Return the edges of a pyramid of the height ``size`` (m) for the first camera and some far apart; z is ahead."""
    shown = [T_display_cam[0]]
    for T in T_display_cam:
        apart = min(float(np.linalg.norm(T[:3, 3] - other[:3, 3])) for other in shown)
        if apart > 3.0 * size and len(shown) < CAMERAS:
            shown.append(T)
    corners = size * np.array([[-0.6, -0.45, 1.0], [0.6, -0.45, 1.0], [0.6, 0.45, 1.0], [-0.6, 0.45, 1.0]])
    edges = [(np.zeros(3), corner) for corner in corners] + list(
        zip(corners, np.roll(corners, -1, axis=0), strict=True)
    )
    ends = np.array(edges)  # (8, 2, 3)
    return np.concatenate([transform(T, ends.reshape(-1, 3)).reshape(-1, 2, 3) for T in shown])


def extent(mesh: Mesh, estimate: Segments) -> tuple[Float[np.ndarray, "3"], float]:
    """Return centre and radius (m) of what a view shows: the surface but for outliers, and the estimated path."""
    most = np.quantile(mesh.vertices, [0.003, 0.997], axis=0)
    every = np.concatenate([most, estimate.reshape(-1, 3)])
    low, high = every.min(axis=0), every.max(axis=0)
    return 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-3)


def facing(T_display_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "2"] | None:
    """Return the horizontal direction into which the cameras looked on average; None where they looked around."""
    mean = T_display_cam[:, :2, 2].mean(axis=0)
    return mean if np.linalg.norm(mean) > ONE_WAY else None


def prepared(
    mesh: Mesh, estimate: Segments, truth: Segments, direction: Float[np.ndarray, "2"] | None
) -> tuple[bytes, bytes]:
    """Return the block that the script reads, and the still picture; both look along ``direction`` first.

    A surface that was seen from one side is drawn from that side only.
    """
    view, image = mesh_view(mesh, STILL_WIDTH, math.inf, direction)
    return packed(mesh, estimate, truth, view), still(view, image, estimate, truth)


def packed(mesh: Mesh, estimate: Segments, truth: Segments, view: View) -> bytes:
    """Return the block that the script reads."""
    low = mesh.vertices.min(axis=0).astype(float)
    step = max(float((mesh.vertices.max(axis=0) - low).max()) / 65535.0, 1e-9)
    places = np.zeros((len(mesh.vertices), 4), "<u2")
    places[:, :3] = np.rint((mesh.vertices - low) / step).clip(0, 65535)
    centre, radius = extent(mesh, estimate)
    head = struct.pack("<4I", len(places), len(mesh.faces), len(estimate), len(truth))
    x, y, z = view.axes[2]
    head += struct.pack("<10f", *low, step, *centre, radius, math.atan2(-y, -x), math.asin(-z))
    colours = np.pad(mesh.colours, ((0, 0), (0, 1)))
    lines = np.concatenate([estimate, truth]).astype("<f4")
    return head + places.tobytes() + colours.tobytes() + mesh.faces.astype("<u4").tobytes() + lines.tobytes()


def still(view: View, image: UInt8[np.ndarray, "h w 3"], estimate: Segments, truth: Segments) -> bytes:
    """Draw both paths on a picture of the surface, as WebP: for paper, and where scripts are off."""
    height, width = image.shape[:2]
    figure = Figure(figsize=(width / 100, height / 100))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image, extent=(0, width, height, 0))
    for segments, colour in ((truth, pictures.TRUE_COLOUR), (estimate, pictures.ESTIMATE_COLOUR)):
        axes.add_collection(LineCollection(list(view.pixels(segments)), colors=colour, linewidths=1.4))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    return pictures.webp(figure, dpi=100)
