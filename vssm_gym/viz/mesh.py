"""Extract the zero level set of a map's mean field as a triangle mesh, and write it (PLY).

Marching cubes (Lewiner et al., 2003) puts vertices on the grid's edges, where the field is linear, so that they lie on
its zero. Only triangles whose vertices were observed, by the renderer's criterion, are kept: behind the band that
images update, the field falls back to the prior, "just free", and that crossing is no surface.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8
from skimage.measure import marching_cubes

from vssm_gym.files.atomic import atomic_write
from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import KNOWN_SHARE


@dataclass(frozen=True)
class Mesh:
    """Hold a surface with the belief at each vertex."""

    vertices: Float[np.ndarray, "vertices 3"]  # m, map frame
    faces: Int[np.ndarray, "faces 3"]  # counter-clockwise seen from free space
    colours: UInt8[np.ndarray, "vertices 3"]  # RGB of the mean field
    variance: Float[np.ndarray, "vertices"]  # m^2, of occupancy: how far the surface may be off


def surface_mesh(m: VoxelMap) -> Mesh:
    """``{p : f_M(p) = 0}`` at the mean, where the map was observed; without vertices where it has no surface.

    Ambiguous cubes get vertices in their inside, off the zero by a fraction of a voxel; smooth surfaces have none.
    """
    # A crossing lies in a block that rays may not skip, or reaches from it into the next: only their box is laid out.
    blocks = np.argwhere(np.asarray(m.empty.rings) == 0)
    if len(blocks) == 0:
        return _mesh(m, np.zeros((0, 3)), np.zeros((0, 3), int))
    first, end = blocks.min(axis=0), np.minimum(blocks.max(axis=0) + 2, m.blocks)
    occupancy = np.array(m.dense(m.occupancy, first, end))  # a copy: marching cubes refuses JAX's read-only memory
    above = occupancy > 0.0
    crossed = _of_cube(above, np.logical_or) & ~_of_cube(above, np.logical_and)
    cubes = np.argwhere(crossed)
    if len(cubes) == 0:
        return _mesh(m, np.zeros((0, 3)), np.zeros((0, 3), int))
    low, high = cubes.min(axis=0), cubes.max(axis=0) + 1
    mask = np.zeros(tuple(high - low + 1), bool)
    mask[1:, 1:, 1:] = crossed[_box(low, high)]  # scikit-image names a cube by its last cell
    # scikit-image uses the left-hand rule: "ascent" makes right-handed normals point out of objects.
    cells, faces, _, _ = marching_cubes(occupancy[_box(low, high + 1)], 0.0, gradient_direction="ascent", mask=mask)
    vertices = np.asarray(m.origin, np.float64) + (cells + low + BLOCK * first) * float(m.voxel_size)
    known = np.asarray(_observed(m, _inside(m, vertices)))[: len(vertices)] >= KNOWN_SHARE
    faces = faces[known[faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return _mesh(m, vertices[used], faces.reshape(-1, 3))


def _mesh(m: VoxelMap, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    rgb, precision = (np.asarray(a)[: len(vertices)] for a in _belief(m, _inside(m, vertices)))
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8),
        1.0 / precision,
    )


@jax.jit
def _observed(m: VoxelMap, p_world: jax.Array) -> jax.Array:
    return m.observed_at(p_world)


@jax.jit
def _belief(m: VoxelMap, p_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return colour, and precision of occupancy."""
    return m.colour_at(p_world), m.precision(p_world)[:, 0]


def _inside(m: VoxelMap, vertices: np.ndarray) -> jax.Array:
    """Move vertices slightly inside the grid for the map's queries, which return the prior outside.

    Zeros fill them up to a power of two: otherwise every number of vertices would need its own compilation.
    """
    inset = np.array([[1e-3], [-1e-3]]) * float(m.voxel_size)
    p_world = np.zeros((1 << max(0, len(vertices) - 1).bit_length(), 3), np.float32)
    p_world[: len(vertices)] = np.clip(vertices, *(m.bounds + inset))
    return jnp.asarray(p_world)


def _box(low: np.ndarray, high: np.ndarray) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(low, high, strict=True))


def _of_cube(cells: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """``combine`` over the eight cells of every cube: ``(nx, ny, nz)`` to ``(nx - 1, ny - 1, nz - 1)``."""
    for axis in range(3):
        n = cells.shape[axis]
        cells = combine(np.take(cells, range(n - 1), axis), np.take(cells, range(1, n), axis))
    return cells


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY with colour and ``variance`` per vertex, atomically."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        "comment vssm_gym: metres in the map's frame; variance of occupancy in square metres\n"
        f"element vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "property float variance\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    vertices = np.empty(len(mesh.vertices), [("xyz", "<f4", 3), ("rgb", "u1", 3), ("variance", "<f4")])
    vertices["xyz"], vertices["rgb"], vertices["variance"] = mesh.vertices, mesh.colours, mesh.variance
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.faces
    with atomic_write(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + vertices.tobytes() + faces.tobytes())
