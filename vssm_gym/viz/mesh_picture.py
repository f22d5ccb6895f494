"""Draw a mesh obliquely from above: parallel projection, z-buffer, Lambert's law; needs no GPU and no window.

    [u v d]^T = [right; down; ahead] p     colour = rgb (MESH_AMBIENT + (1 - MESH_AMBIENT) max(0, n . light))

Faces are drawn from the side of free space only, so that ceilings, and walls seen from behind, disappear. Geometry
above ``cut`` is left out, as in an architect's model: near walls would hide the rooms behind them.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit

from vssm_gym.viz.mesh import Mesh

MESH_CUT = 1.6  # m: above door handles and most furniture
ELEVATION = math.radians(52.0)  # of the viewer above the horizon
# Of the view from straight along the shorter side, so that two sides of objects are seen.
VIEW_TURN = math.radians(-20.0)
LIGHT = (-0.35, -0.5, 0.8)  # towards it in the viewer's level frame: right, ahead, up
MESH_AMBIENT = 0.75  # share of the light that comes from everywhere
PAPER = 238  # pale grey, so that unobserved space is not taken for a white wall
SMOOTH = 2  # supersampling factor
_MARGIN = 0.02  # of the longer side, around what is drawn


@dataclass(frozen=True)
class View:
    """Hold a parallel projection: ``[u v]^T = scale ([right; down] p - first)``, pixels."""

    axes: Float[np.ndarray, "3 3"]  # rows: right, down, ahead
    first: Float[np.ndarray, "2"]  # m, of the picture's upper left corner
    scale: float  # pixels a metre

    def pixels(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 2"]:
        """Project points to u (right) and v (down)."""
        return (points @ self.axes[:2].T - self.first) * self.scale


def mesh_picture(mesh: Mesh, width: int = 1400, cut: float = MESH_CUT) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the mesh in its colours on pale grey, the longer side of its floor across the picture.

    Args:
        mesh: z up; faces counter-clockwise seen from free space.
        width: pixels; the height follows.
        cut: m, above which nothing is drawn.

    Returns:
        RGB; one empty row where nothing of the mesh is below ``cut``.
    """
    return mesh_view(mesh, width, cut)[1]


def mesh_view(
    mesh: Mesh, width: int, cut: float, facing: Float[np.ndarray, "2"] | None = None
) -> tuple[View, UInt8[np.ndarray, "height width 3"]]:
    """Draw as :func:`mesh_picture`, along the horizontal direction ``facing`` if given.

    Returns:
        The projection, and the picture.
    """
    low = mesh.vertices[:, 2] < cut
    faces = mesh.faces[low[mesh.faces].any(axis=1)]
    if len(faces) == 0:
        return View(np.eye(3), np.zeros(2), 1.0), np.full((1, width, 3), PAPER, np.uint8)
    used = np.unique(faces)
    if facing is None:
        right, ahead = _level_axes(mesh.vertices[used, :2].astype(np.float64))
    else:
        x, y = facing / np.linalg.norm(facing)
        right, ahead = np.array([y, -x, 0.0]), np.array([x, y, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    view = np.stack(
        [
            right,
            -math.sin(ELEVATION) * ahead - math.cos(ELEVATION) * up,
            math.cos(ELEVATION) * ahead - math.sin(ELEVATION) * up,
        ]
    )
    points = mesh.vertices.astype(np.float64) @ view.T
    first, last = (bound(points[used, :2], axis=0) for bound in (np.min, np.max))
    margin = _MARGIN * float((last - first).max())
    scale = SMOOTH * width / float(last[0] - first[0] + 2.0 * margin)
    height = SMOOTH * math.ceil(scale * float(last[1] - first[1] + 2.0 * margin) / SMOOTH)
    points[:, :2] = (points[:, :2] - first + margin) * scale
    shown = View(view, first - margin, scale / SMOOTH)
    light = np.array(LIGHT) @ np.stack([right, ahead, up])
    lit = np.maximum(_normals(mesh) @ (light / np.linalg.norm(light)), 0.0)
    rgb = mesh.colours * (MESH_AMBIENT + (1.0 - MESH_AMBIENT) * lit)[:, None]
    image = np.full((height, SMOOTH * width, 3), float(PAPER))
    _draw(points, mesh.vertices[:, 2].astype(np.float64), rgb, faces.astype(np.int64), cut, image)
    reduced = image.reshape(height // SMOOTH, SMOOTH, width, SMOOTH, 3).mean(axis=(1, 3))
    return shown, np.rint(reduced).astype(np.uint8)


def _level_axes(xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the picture's right and ahead directions as horizontal unit vectors."""
    size = xy.max(axis=0) - xy.min(axis=0)
    angle = VIEW_TURN + (0.0 if size[0] >= size[1] else 0.5 * math.pi)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def _normals(mesh: Mesh) -> Float[np.ndarray, "vertices 3"]:
    """Return the normal of each vertex, into free space: the area-weighted mean over its faces."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros((len(mesh.vertices), 3))
    for k in range(3):
        np.add.at(total, mesh.faces[:, k], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


@njit(cache=True, nogil=True)
def _draw(points, z, rgb, faces, cut, image):
    """Draw faces into ``image`` (height, width, 3) from screen x, y (down), depth, height and colour of vertices."""
    height, width = image.shape[:2]
    nearest = np.full((height, width), np.inf)
    for f in range(len(faces)):
        a, b, c = faces[f]
        xa, ya, xb, yb, xc, yc = points[a, 0], points[a, 1], points[b, 0], points[b, 1], points[c, 0], points[c, 1]
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area >= -1e-12:  # y points down: what is counter-clockwise to the viewer is negative
            continue
        for j in range(max(0, math.ceil(min(ya, yb, yc) - 0.5)), min(height, int(max(ya, yb, yc) + 0.5) + 1)):
            for i in range(max(0, math.ceil(min(xa, xb, xc) - 0.5)), min(width, int(max(xa, xb, xc) + 0.5) + 1)):
                x, y = i + 0.5, j + 0.5
                wa = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) / area
                wb = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) / area
                wc = 1.0 - wa - wb
                if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                    continue
                depth = wa * points[a, 2] + wb * points[b, 2] + wc * points[c, 2]
                if depth >= nearest[j, i] or wa * z[a] + wb * z[b] + wc * z[c] > cut:
                    continue
                nearest[j, i] = depth
                for k in range(3):
                    image[j, i, k] = wa * rgb[a, k] + wb * rgb[b, k] + wc * rgb[c, k]
