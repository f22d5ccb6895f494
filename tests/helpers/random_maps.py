"""Draw random voxel maps of every kind that a search or an index must handle, all of one size."""

import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from tests.helpers.analytic_room import box_distance, cell_centres
from vssm_gym.maps.voxel_map import VoxelMap

SHAPE = (24, 24, 16)  # 3 x 3 x 2 blocks
VOXEL = 0.1
ORIGIN = (-1.2, -0.9, 0.3)
KINDS = ("blobs", "distance", "thin walls", "noise", "sparse", "empty", "solid")

seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(KINDS)


def _boxes(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the truncated signed distance of a few boxes, as map updates produce it."""
    occupancy = np.full(p.shape[:3], -0.2)
    for _ in range(rng.integers(1, 5)):
        centre, half = rng.uniform(p[0, 0, 0], p[-1, -1, -1]), rng.uniform(0.03, 0.6, 3)
        occupancy = np.maximum(occupancy, -box_distance(p, (tuple(centre - half), tuple(centre + half))))
    return np.clip(occupancy, -0.2, 0.2)


def _thin_walls(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return single layers of cells slightly above zero in a field slightly below it."""
    occupancy = np.full(p.shape[:3], -0.001)
    for _ in range(rng.integers(1, 4)):
        axis = int(rng.integers(3))
        layer: list[slice | int] = [slice(None)] * 3
        layer[axis] = int(rng.integers(p.shape[axis]))
        occupancy[tuple(layer)] = rng.uniform(0.001, 0.2)
    return occupancy


def random_occupancy(kind: str, seed: int, p: np.ndarray) -> np.ndarray:
    """Return occupancy (nx, ny, nz) at cell centres ``p``."""
    rng = np.random.default_rng(seed)
    shape = p.shape[:3]
    if kind == "blobs":
        field = gaussian_filter(rng.standard_normal(shape), rng.uniform(1.0, 3.0))
        return field / field.std() - rng.uniform(0.5, 2.5)
    if kind == "distance":
        return _boxes(p, rng)
    if kind == "thin walls":
        return _thin_walls(p, rng)
    if kind == "noise":
        return rng.standard_normal(shape) - rng.uniform(0.0, 3.0)
    if kind == "sparse":
        return np.where(rng.uniform(size=shape) < 0.002, 0.3, -0.3)
    return np.full(shape, {"empty": -0.001, "solid": 0.1}[kind])


def random_map(kind: str, seed: int) -> VoxelMap:
    """Return a map of random occupancy and colour."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    rng = np.random.default_rng([seed, 1])
    occupancy = random_occupancy(kind, seed, cell_centres(m)).astype(np.float32)
    colour = jnp.asarray(rng.uniform(size=m.colour.shape), jnp.float32)
    coloured = VoxelMap(
        m.occupancy, m.occupancy_precision, colour, m.colour_precision, m.empty, m.origin, m.voxel_size, m.blocks
    )
    return coloured.with_occupancy(m.blocked(jnp.asarray(occupancy)))
