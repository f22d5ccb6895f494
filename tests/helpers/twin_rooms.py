"""Make the map of two equal rooms side by side, which differ in the colours of one wall of one of them, if at all."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import shapely

from tests.helpers.planning_worlds import VOXEL, voxel_map
from vssm_gym.maps.voxel_map import VoxelMap

APART = 3.5  # m along x from any point of one room to its twin in the other
WIDTH, DEPTH = 3.0, 2.5  # m
POSTER = 6.3  # m: what lies beyond has colours of its own, where the rooms differ


def twin_rooms(differ: bool) -> VoxelMap:
    """Return the map; rooms are ``[0, 3] x [0, 2.5]`` and its twin, and only the twin's east wall may differ."""
    wall = (shapely.box(WIDTH, -1.0, APART, DEPTH + 1.0), 0.0, 2.0)
    pieces = [((0.3, 1.9, 1.0, 2.4), 0.7), ((2.4, 0.2, 2.8, 0.9), 0.5), ((1.2, 0.0, 1.7, 0.3), 1.1)]
    solids = [
        (shapely.box(x0 + shift, y0, x1 + shift, y1), 0.0, top)
        for (x0, y0, x1, y1), top in pieces
        for shift in (0.0, APART)
    ]
    m = voxel_map(shapely.box(0.0, 0.0, APART + WIDTH, DEPTH), [wall, *solids])
    colour = np.array(m.dense(m.colour))
    cells, first = round(APART / VOXEL), round(0.3 / VOXEL)  # the grid begins 0.3 m before the floor
    end = first + cells
    here = slice(first - 6, end - 6)
    there = colour[first - 6 + cells : end - 6 + cells]
    poster = there[round(POSTER / VOXEL) - cells :].copy()
    there[:] = colour[here][: len(there)]
    if differ:
        there[round(POSTER / VOXEL) - cells :] = 1.0 - poster
    return eqx.tree_at(lambda m: m.colour, m, m.blocked(jnp.asarray(colour, jnp.float32)))
