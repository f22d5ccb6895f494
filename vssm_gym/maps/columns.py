"""Project a map to the floor plan: the highest occupancy of each column, and the distance to the nearest obstacle.

    top(x, y) = max over z of o(x, y, z)      o the mean occupancy (m, positive inside objects) where it was observed

Planners (:mod:`vssm_gym.planning.clearance`) and the imagined robots of :mod:`vssm_gym.envs.world_model` test
collisions against the same columns.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from vssm_gym.maps.voxel_map import OBSERVATION_STD, OBSERVED_PRECISION, VoxelMap

BODY_HEIGHTS = (0.08, 0.5)  # m: above the noise of a learned floor, up to the top of the holonomic robot and its camera
OBSERVED_SHARE = 0.5  # of a column's heights that must be observed; below a visible table top they are unobserved


def observed_columns(
    voxel_map: VoxelMap, z_min: float, z_max: float, resolution: float, deviations: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return each column's highest mean occupancy (m, -inf where unobserved) and the observed share of its heights.

    With ``deviations``, return the highest ``mean + deviations std`` instead, ``std = 0.03 m / sqrt(n)`` after ``n``
    observations.

    Column ``[ix, iy]`` lies ``resolution * (ix, iy)`` m from the lowest cell centre of the map; heights from ``z_min``
    to
    ``z_max`` m are evaluated. Both results are float64 ``(nx, ny)``.
    """
    low, high = voxel_map.bounds
    shape = tuple(int(n) for n in np.floor((high - low)[:2] / resolution).astype(int) + 1)
    spacing = 0.5 * float(voxel_map.voxel_size)  # finer adds nothing: the field is linear between cells
    heights = np.linspace(z_min, z_max, max(2, int(np.ceil((z_max - z_min) / spacing)) + 1))
    top, share = _columns(
        voxel_map, jnp.asarray(heights, jnp.float32), jnp.float32(resolution), shape, jnp.float32(deviations)
    )
    return np.asarray(top, np.float64), np.asarray(share, np.float64)


@partial(jax.jit, static_argnames="shape")
def _columns(
    voxel_map: VoxelMap, heights: jax.Array, resolution: jax.Array, shape: tuple[int, int], deviations: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return highest occupancy and observed share of each column, both ``(nx, ny)``, computed layer by layer."""
    x = voxel_map.origin[0] + resolution * jnp.arange(shape[0])
    y = voxel_map.origin[1] + resolution * jnp.arange(shape[1])
    xy = jnp.stack(jnp.meshgrid(x, y, indexing="ij"), axis=-1)

    def layer(carry, z):
        top, known = carry
        p_world = jnp.concatenate([xy, jnp.full((*shape, 1), z)], axis=-1)
        precision = voxel_map.precision(p_world)[..., 0]
        observed = precision > OBSERVED_PRECISION
        highest = voxel_map.occupancy_at(p_world) + deviations * OBSERVATION_STD * jax.lax.rsqrt(precision)
        # The prior mean is no measurement: an unobserved point carries no information about a surface.
        occupancy = jnp.where(observed, highest, -jnp.inf)
        return (jnp.maximum(top, occupancy), known + observed), None

    (top, known), _ = jax.lax.scan(layer, (jnp.full(shape, -jnp.inf), jnp.zeros(shape)), heights)
    return top, known / heights.shape[0]


def level_distance(depth: np.ndarray, resolution: float) -> np.ndarray:
    """Return the signed distance of cell centres to the zero level of ``depth (nx, ny)``, m; positive outside.

    The level is located by linear interpolation between neighbouring cells, and each cell gets its distance to the
    nearest crossing; a distance transform of whole cells would be off by up to half a cell. Depths (m, positive inside
    obstacles) only locate the surface between neighbours: away from it they need not be distances.
    """
    inside, surface = level_crossings(depth, resolution)
    if len(surface):
        cells = np.argwhere(np.ones(inside.shape, dtype=bool))
        distance = resolution * cKDTree(surface).query(cells)[0].reshape(inside.shape)
    else:
        distance = np.full(inside.shape, resolution * np.hypot(*inside.shape))
    return np.ascontiguousarray(np.where(inside, -distance, distance), dtype=np.float32)


def level_crossings(depth: np.ndarray, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells lie inside, and where the zero level crosses the grid's lines, ``(n, 2)`` in cells."""
    depth = np.clip(np.asarray(depth, dtype=np.float64), -resolution, resolution)
    inside = depth > 0.0
    crossings: list[np.ndarray] = []
    for axis in (0, 1):
        before, after = (np.moveaxis(depth, axis, 0)[k] for k in (slice(None, -1), slice(1, None)))
        cell = np.argwhere((before > 0.0) != (after > 0.0))
        a, b = before[tuple(cell.T)], after[tuple(cell.T)]
        point = cell.astype(np.float64)
        point[:, 0] += a / (a - b)
        crossings.append(point if axis == 0 else point[:, ::-1])
    return inside, np.concatenate(crossings)
