"""Make exact maps of boxes: the negative signed distance in every cell."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.maps.voxel_map import VoxelMap

LOW, HIGH = (-1.0, -1.5, -0.3), (1.8, 1.7, 2.5)  # of a map, m


def signed_distance(box: SolidBox, p: np.ndarray) -> np.ndarray:
    """Return the distance of points ``(..., 3)`` to a box, m, below 0 inside."""
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    local = (p - np.array(box.center)) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    q = np.abs(local) - 0.5 * np.array(box.size)
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)


def map_of(
    boxes: Sequence[SolidBox],
    shift: float = 0.0,
    observed: bool = True,
    voxel: float = 0.05,
    low: Sequence[float] = LOW,
    high: Sequence[float] = HIGH,
) -> VoxelMap:
    """Return a map of ``boxes`` with all cells observed, or none; shifted along x by ``shift`` m."""
    shape = np.ceil((np.array(high) - low) / voxel).astype(int)
    m = VoxelMap.prior(np.array(low), voxel, (int(shape[0]), int(shape[1]), int(shape[2])))
    index = np.stack(np.meshgrid(*(np.arange(n) for n in m.shape), indexing="ij"), axis=-1)
    p = np.array(low) - np.array([shift, 0.0, 0.0]) + voxel * index
    field = np.full(m.shape, -np.inf)
    for box in boxes:
        field = np.maximum(field, -signed_distance(box, p))
    m = m.with_occupancy(m.blocked(jnp.asarray(field, jnp.float32)))
    precision = jnp.full_like(m.occupancy, 4.0 if observed else 0.01)
    return eqx.tree_at(lambda m: (m.occupancy_precision, m.colour_precision), m, (precision, precision))
