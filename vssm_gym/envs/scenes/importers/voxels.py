"""Approximate shapes by upright boxes: a shape is cut into cells, and equal cells join to larger boxes.

Cells fill the shape's bounding box evenly, at most VOXEL_EDGE wide; a cell is solid where its centre lies in the shape,
or, for meshes, where the surface passes through it. So a box is off by half a cell at most.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from vssm_gym.envs.scenes.importers.rectangles import cover

VOXEL_EDGE = 0.04  # m
MOST_VOXELS = 2_000_000  # of one shape; a larger one has larger cells
SURFACE_SAMPLES = 4_000_000  # points on one mesh's surface

Extent = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]  # lowest and highest corner, m


def voxelised(low: np.ndarray, high: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> list[Extent]:
    """Return boxes that fill the shape between ``low`` and ``high`` (3,) m; ``inside`` tests points (n, 3)."""
    shape, size = _grid(low, high)
    centers = [low[k] + (np.arange(shape[k]) + 0.5) * size[k] for k in range(3)]
    layers = np.empty(shape, dtype=bool)
    plane = np.stack(np.meshgrid(centers[0], centers[1], [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    for k, z in enumerate(centers[2]):
        plane[:, 2] = z
        layers[:, :, k] = inside(plane).reshape(shape[0], shape[1])
    return _boxes(layers, low, size)


def voxelised_surface(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> list[Extent]:
    """Return boxes around the surface of triangles, m."""
    if not len(faces):
        return []
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shape, size = _grid(low, high)
    corners = vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    step = 0.5 * float(size.max())
    parts = np.maximum(np.ceil(edges / step), 1).astype(int)
    while np.sum((parts + 1.0) * (parts + 2.0) / 2.0) > SURFACE_SAMPLES:
        step *= 1.5
        parts = np.maximum(np.ceil(edges / step), 1).astype(int)
        shape, size = _grid(low, high, 2.0 * step)
    solid = np.zeros(shape, dtype=bool)
    for n in np.unique(parts):
        i, j = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T / n
        weights = np.stack([i, j, 1.0 - i - j], axis=1)
        group = corners[parts == n]
        for first in range(0, len(group), block := max(1, 500_000 // len(weights))):
            points = np.einsum("wk,fkd->fwd", weights, group[first : first + block]).reshape(-1, 3)
            index = np.clip(((points - low) / size).astype(int), 0, np.array(shape) - 1)
            solid[tuple(index.T)] = True
    return _boxes(solid, low, size)


def _grid(low: np.ndarray, high: np.ndarray, cell: float = VOXEL_EDGE) -> tuple[tuple[int, int, int], np.ndarray]:
    """Return number and size of the cells."""
    extent = np.maximum(high - low, 1e-3)
    while np.prod(np.ceil(extent / cell - 1e-9)) > MOST_VOXELS:
        cell *= 1.26
    shape = np.maximum(np.ceil(extent / cell - 1e-9), 1).astype(int)
    return (int(shape[0]), int(shape[1]), int(shape[2])), extent / shape


def _boxes(solid: Bool[np.ndarray, "nx ny nz"], low: np.ndarray, size: np.ndarray) -> list[Extent]:
    """Return greedy rectangles of each run of equal layers."""
    boxes: list[Extent] = []
    first = 0
    for k in range(1, solid.shape[2] + 1):
        if k < solid.shape[2] and np.array_equal(solid[:, :, k], solid[:, :, first]):
            continue
        layer = solid[:, :, first]
        for i0, i1, j0, j1 in cover(layer, layer):
            boxes.append((low + size * (i0, j0, first), low + size * (i1, j1, k)))
        first = k
    return boxes


def inside_of(shape: str, size: Float[np.ndarray, "3"]) -> Callable[[np.ndarray], np.ndarray]:
    """Return the test of points (n, 3) in a shape's own frame; ``size`` as in MuJoCo (radii, half lengths), m."""
    half = np.maximum(size, 0.5 * VOXEL_EDGE)  # a part thinner than a cell would fall between two centres
    if shape == "box":
        return lambda p: (np.abs(p) <= half).all(axis=-1)
    if shape in ("sphere", "ellipsoid"):
        radii = half if shape == "ellipsoid" else np.full(3, half[0])
        return lambda p: np.sum((p / radii) ** 2, axis=-1) <= 1.0
    if shape == "cylinder":
        return lambda p: (np.hypot(p[..., 0], p[..., 1]) <= half[0]) & (np.abs(p[..., 2]) <= half[1])
    assert shape == "capsule", shape
    cap = lambda p: np.maximum(np.abs(p[..., 2]) - size[1], 0.0)
    return lambda p: p[..., 0] ** 2 + p[..., 1] ** 2 + cap(p) ** 2 <= half[0] ** 2


def bounds_of(shape: str, size: Float[np.ndarray, "3"]) -> Float[np.ndarray, "8 3"]:
    """Return the corners of a shape's bounding box in its own frame, m."""
    half = {
        "box": size,
        "ellipsoid": size,
        "sphere": np.full(3, size[0]),
        "cylinder": np.array([size[0], size[0], size[1]]),
        "capsule": np.array([size[0], size[0], size[0] + size[1]]),
    }[shape]
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return signs * half


def yaw_of(rotation: Float[np.ndarray, "3 3"], half: Float[np.ndarray, "3"]) -> float:
    """Return the direction in the plane, rad, of the axis that reaches farthest there.

    Cells along it make fewest boxes.
    """
    reach = np.linalg.norm(rotation[:2], axis=0) * half
    x, y = rotation[:2, int(np.argmax(reach))]
    return math.atan2(y, x)
