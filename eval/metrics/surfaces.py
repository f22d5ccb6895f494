"""Compare a map's surface with those surfaces of an apartment that a robot could ever see.

    completeness = |{p in S : the map's surface crosses the normal at p within 0.1 m}| / |S|
    accuracy     = mean over the map's surface of the distance to the scene's nearest face
    completion   = mean over p in S of the distance to the map's surface, each no more than ``CLIPPED_AT``

``S`` are the points of the scene's faces that a camera on the robot sees from anywhere the robot can reach, level, in
any direction, no farther than coverage counts: surfaces behind furniture enter no score, so that 1 can be
attained. ``S`` is ground truth: it evaluates explorers, which never see it.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.tasks.coverage import SEEING_RANGE
from vssm_gym.envs.tasks.scene_cache import SceneCache
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import KNOWN_SHARE, TAU
from vssm_gym.viz.mesh import Mesh, surface_mesh

POINT_SPACING = 0.1  # m between points of S: one a cell of this size on each face
VIEWPOINT_SPACING = 0.4  # m between viewpoints
RAYS_AROUND, RAYS_UPWARDS = 240, 60  # rays of a whole turn, and from the image's lower edge to its upper one
FOUND_WITHIN = 0.1  # m: largest error of a map's surface that counts as found
NORMAL_SAMPLES = 9  # samples of a normal: closer together than half a cell of any map in use
ACCURATE_WITHIN = 0.05  # m: threshold of the proportions of accurate and of complete surface
CLIPPED_AT = 0.5  # m: distances are clipped here, so that a room that was never entered counts the same wherever it is
DRAWN_POINTS = 10_000  # points of the mesh, and of the surface, that accuracy and completion are computed from
SEED = 0  # of the points that are drawn: a map's scores repeat exactly
_CANDIDATES = 8  # triangles with the nearest centres, among which the nearest triangle is searched


@dataclass(frozen=True, eq=False)
class Surface:
    """Hold points of faces and their outward normals in the world frame, m. Compared by identity."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]

    def thinned(self, n: int) -> "Surface":
        """Return at most ``n`` of the points, drawn uniformly."""
        if len(self.points) <= n:
            return self
        chosen = np.random.default_rng(SEED).choice(len(self.points), n, replace=False)
        return Surface(self.points[chosen], self.normals[chosen])


def observable_surface(scene_cache: SceneCache) -> Surface:
    """Compute ``S`` of the module: about one point a ``POINT_SPACING``^2 of every face, in a fixed order."""
    space, config = scene_cache.sampler.space, scene_cache.renderer.config
    low, high = np.split(np.array(space.largest.bounds), 2)
    xs, ys = (np.arange(a, b, VIEWPOINT_SPACING) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    places = grid[shapely.contains_xy(space.largest, grid)]
    if not len(places):
        places = np.array(space.largest.representative_point().coords)
    half = math.tan(0.5 * config.hfov) * config.height / config.width  # slope of the image's upper edge
    bearing = np.linspace(-math.pi, math.pi, RAYS_AROUND, endpoint=False)
    a, slope = (g.ravel() for g in np.meshgrid(bearing, np.linspace(-half, half, RAYS_UPWARDS), indexing="ij"))
    # z-depth 1 each: a camera that turns has every bearing in the middle of its image
    directions = np.stack([np.cos(a), np.sin(a), slope], axis=-1).astype(np.float32)
    faces = _Faces.of(scene_cache.renderer.boxes)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for x, y in places:
        origin = np.array([x, y, scene_cache.robot.camera_height])
        t, box = scene_cache.renderer.tracer.trace(origin, directions)
        seen = (box >= 0) & (t <= SEEING_RANGE)
        points = origin + t[seen, None] * directions[seen].astype(np.float64)
        keys, normals = faces.cells(points, box[seen])
        _, first = np.unique(keys, return_index=True)
        found.append((keys[first], points[first], normals[first]))
    keys, points, normals = (np.concatenate(parts) for parts in zip(*found, strict=True))
    _, first = np.unique(keys, return_index=True)
    return Surface(points[first], normals[first])


@dataclass(frozen=True)
class _Faces:
    """Hold boxes as arrays: centres (n, 3), half extents (n, 3), cosine and sine of the yaw (n,)."""

    centre: np.ndarray
    half: np.ndarray
    c: np.ndarray
    s: np.ndarray

    @classmethod
    def of(cls, boxes: list[SolidBox]) -> "_Faces":
        yaw = np.array([box.yaw for box in boxes])
        half = 0.5 * np.array([box.size for box in boxes])
        return cls(np.array([box.center for box in boxes]), half, np.cos(yaw), np.sin(yaw))

    def cells(self, points: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the number (n,) of the cell of the face that each point lies on, and the face's normal (n, 3)."""
        d, c, s = points - self.centre[box], self.c[box], self.s[box]
        local = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=-1)
        every = np.arange(len(points))
        axis = np.argmin(self.half[box] - np.abs(local), axis=1)
        sign = np.where(local[every, axis] > 0.0, 1.0, -1.0)
        u, v = (np.floor(local[every, (axis + k) % 3] / POINT_SPACING).astype(np.int64) + (1 << 14) for k in (1, 2))
        keys = (((box.astype(np.int64) * 6 + 2 * axis + (sign > 0.0)) << 15) + u << 15) + v
        level = np.stack([np.where(axis == 0, c, -s), np.where(axis == 0, s, c), np.zeros(len(points))], axis=-1)
        normals = np.where((axis == 2)[:, None], [0.0, 0.0, 1.0], level) * sign[:, None]
        return keys, normals

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance (n,) to the nearest face of any box, no more than ``CLIPPED_AT``."""
        nearest = np.full(len(points), CLIPPED_AT)
        reach = np.linalg.norm(self.half, axis=1) + CLIPPED_AT
        for i in range(len(self.centre)):
            d = points - self.centre[i]
            near = np.flatnonzero(np.einsum("na,na->n", d, d) < reach[i] ** 2)
            x, y, z = d[near].T
            local = np.stack([self.c[i] * x + self.s[i] * y, self.c[i] * y - self.s[i] * x, z], axis=-1)
            q = np.abs(local) - self.half[i]
            outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
            nearest[near] = np.minimum(nearest[near], np.abs(outside + np.minimum(q.max(axis=1), 0.0)))
        return nearest


def completeness(m: VoxelMap, surface: Surface) -> float:
    """Return the proportion of ``surface`` that ``m`` shows within ``FOUND_WITHIN``; see the module."""
    found = _found(m, jnp.asarray(surface.points, jnp.float32), jnp.asarray(surface.normals, jnp.float32))
    return float(np.mean(np.asarray(found)))


@jax.jit
def _found(m: VoxelMap, points: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Bool[Array, "n"]:
    """Return whether the field rises through the surface's threshold along the inward normal, where it was observed.

    The first such crossing decides. A wall's far side is none, because there the field falls.
    """
    offsets = jnp.linspace(FOUND_WITHIN, -FOUND_WITHIN, NORMAL_SAMPLES)
    occupancy = m.occupancy_at(points[:, None] + offsets[:, None] * normals[:, None])
    before, after = occupancy[:, :-1], occupancy[:, 1:]
    rises = (before <= TAU) & (after > TAU)
    first = jnp.argmax(rises, axis=1)[:, None]
    before, after = (jnp.take_along_axis(a, first, axis=1)[:, 0] for a in (before, after))
    share = (TAU - before) / jnp.where(after > before, after - before, 1.0)
    offset = FOUND_WITHIN + (first[:, 0] + share) * (offsets[1] - offsets[0])
    known = m.observed_at(points + offset[:, None] * normals) >= KNOWN_SHARE
    return jnp.any(rises, axis=1) & known


def mesh_quality(m: VoxelMap, surface: Surface, boxes: list[SolidBox]) -> dict[str, float | None]:
    """Compute the accuracy and completion of the map's mesh, m; see the module.

    Args:
        m: the map.
        surface: the observable surface of the scene.
        boxes: all solid boxes of the scene.

    Returns:
        ``accuracy`` and ``accurate_5cm`` (proportion of the mesh within 5 cm of the scene; both None where the map
        shows no surface), ``completion`` and ``complete_5cm`` (proportion of the surface within 5 cm of the mesh).
    """
    mesh = surface_mesh(m)
    if not len(mesh.faces):
        return {"accuracy": None, "accurate_5cm": None, "completion": CLIPPED_AT, "complete_5cm": 0.0}
    off = _Faces.of(boxes).distance(sample_mesh(mesh, DRAWN_POINTS, SEED))
    missing = distance_to_mesh(surface.thinned(DRAWN_POINTS).points, mesh)
    return {
        "accuracy": float(off.mean()),
        "accurate_5cm": float(np.mean(off <= ACCURATE_WITHIN)),
        "completion": float(missing.mean()),
        "complete_5cm": float(np.mean(missing <= ACCURATE_WITHIN)),
    }


def sample_mesh(mesh: Mesh, n: int, seed: int) -> Float[np.ndarray, "n 3"]:
    """Draw ``n`` points of a mesh, uniform over its area."""
    rng = np.random.default_rng(seed)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(area), n, p=area / area.sum())
    u, v = np.sqrt(rng.random((n, 1))), rng.random((n, 1))  # uniform over a triangle (Turk, 1990)
    return (1.0 - u) * a[chosen] + u * (1.0 - v) * b[chosen] + u * v * c[chosen]


def distance_to_mesh(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float[np.ndarray, "n"]:
    """Return the distance to a mesh, no more than ``CLIPPED_AT``; exact for the compact triangles of marching cubes."""
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    k = min(_CANDIDATES, len(triangles))
    _, which = cKDTree(triangles.mean(axis=1)).query(points, k=k)
    which = which.reshape(len(points), k)
    nearest = closest_point(triangles[which.ravel()], np.repeat(points, k, axis=0))
    distance = np.linalg.norm(nearest.reshape(len(points), k, 3) - points[:, None], axis=-1).min(axis=1)
    return np.minimum(distance, CLIPPED_AT)
