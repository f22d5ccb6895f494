"""Cut the boxes' faces into triangles with normals and texture coordinates, for an OpenGL renderer.

    p = c + R (x, y, z),    (u, v) = tiles per metre * (metres right, metres down), as in :func:`shading.shade`

Faces are cut into cells, because OpenGL's lights are computed at the corners and interpolated between them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vssm_gym.envs.rendering.shading import texture_shifts
from vssm_gym.envs.scenes.solids import SolidBox

FACE_CELL = 1.0  # m, longest edge of a cell: a lamp at the camera is then right to a few grey levels
_MOST = 32  # cells along an edge, however long it is


@dataclass(frozen=True)
class Triangles:
    """Hold triangles in the world frame; corners of a triangle run counter-clockwise as seen from outside."""

    vertices: Float[np.ndarray, "n 3"]  # m
    normals: Float[np.ndarray, "n 3"]
    texture: Float[np.ndarray, "n 2"]  # tiles, u to the right and v down
    triangles: Int[np.ndarray, "m 3"]  # rows of the above


def box_triangles(boxes: Sequence[SolidBox]) -> Triangles:
    """Return all faces of ``boxes``, cut into cells of at most ``FACE_CELL`` (longer on faces beyond 32 cells)."""
    vertices, normals, texture, triangles = [], [], [], []
    count = 0
    for box in boxes:
        for axis in range(3):
            for sign in (-1.0, 1.0):
                p, n, uv, rows = _face(box, axis, sign)
                vertices.append(p)
                normals.append(np.broadcast_to(n, p.shape))
                texture.append(uv)
                triangles.append(rows + count)
                count += len(p)
    return Triangles(*(np.concatenate(parts) for parts in (vertices, normals, texture, triangles)))


def _face(box: SolidBox, axis: int, sign: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, normal, texture coordinates and triangles of the box's face on side ``sign`` of ``axis``."""
    across, along = (axis + 1) % 3, (axis + 2) % 3
    n_across, n_along = (min(_MOST, max(1, math.ceil(box.size[a] / FACE_CELL))) for a in (across, along))
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, n_across + 1), np.linspace(-0.5, 0.5, n_along + 1), indexing="ij")
    p = np.empty((a.size, 3))
    p[:, axis] = 0.5 * sign * box.size[axis]
    p[:, across], p[:, along] = a.ravel() * box.size[across], b.ravel() * box.size[along]

    (ox, oy, oz), (kx, ky, kz) = texture_shifts(box)
    x, y, z = p.T
    if axis == 0:
        u, v = sign * (y + oy) + ky, kz - z - oz
    elif axis == 1:
        u, v = kx - sign * (x + ox), kz - z - oz
    else:
        u, v = x + ox + kx, ky - y - oy

    corner = np.arange(a.size).reshape(a.shape)
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    if sign < 0.0:  # seen from the other side
        quads = quads[:, ::-1]
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    R_world_box = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    normal = sign * R_world_box[:, axis]
    uv = np.stack([u, v], axis=-1) / box.material.scale
    return p @ R_world_box.T + box.center, normal, uv, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
