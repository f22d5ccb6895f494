"""Make learned maps of simple floor plans, and random grids, for the tests of planning and agents."""

from collections.abc import Callable

import equinox as eqx
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import shapely
from scipy.ndimage import gaussian_filter

from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap

VOXEL = 0.05  # m
CEILING = 2.0  # m
TRUNCATION = 0.1  # m, two voxels, as the closed-form update leaves it
OBSERVATIONS = 20.0  # precision of an observed cell, 1/m^2
# Of twin rooms: m along x from any point of one to its twin in the other; their size; what lies beyond the poster's
# edge along x has colours of its own, where they differ.
APART = 3.5
WIDTH, DEPTH = 3.0, 2.5
POSTER = 6.3


def signed_depth(solid: shapely.Geometry, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return signed distance to the border of ``solid``, positive inside; float64, the shape of ``x``."""
    points, boundary = shapely.points(x, y), solid.boundary
    shapely.prepare([solid, boundary])  # an index over the edges: thousands of points are asked
    distance = shapely.distance(boundary, points)
    return np.where(shapely.covers(solid, points), distance, -distance)


def clearance_map(floor: shapely.Polygon, solid: shapely.Geometry, resolution: float = 0.025) -> ClearanceMap:
    """Return the clearance of ``floor`` minus ``solid``, from exact distances."""
    low, high = np.split(np.array(floor.bounds), 2)
    axes = [np.arange(a - 0.2, b + 0.2, resolution) for a, b in zip(low, high, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    outside = floor.buffer(1.0) - floor
    return ClearanceMap.from_occupancy(
        signed_depth(outside | solid, x, y), np.array([axes[0][0], axes[1][0]]), resolution
    )


def voxel_map(
    floor: shapely.Polygon,
    solids: list[tuple[shapely.Polygon, float, float]],
    observed: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> VoxelMap:
    """Return the map of a mapped room: truncated signed distances to floor, walls, ceiling, ``solids``.

    ``solids`` are prisms ``(polygon, bottom, top)``, metres. Cells deeper than the truncation inside a solid, and where
    ``observed(x, y, z)`` is false, keep the prior. Colours are smooth noise, so that images can be aligned.
    """
    low, high = np.split(np.array(floor.bounds), 2)
    origin = np.array([*(low - 0.3), -0.2])
    shape = tuple(int(n) for n in np.ceil((np.array([*(high + 0.3), CEILING + 0.2]) - origin) / VOXEL))
    prior = VoxelMap.prior(origin, VOXEL, (shape[0], shape[1], shape[2]))
    axes = [origin[a] + VOXEL * np.arange(prior.shape[a]) for a in range(3)]
    x, y = np.meshgrid(axes[0], axes[1], indexing="ij")
    z = axes[2][None, None]
    occupancy = np.maximum(signed_depth(floor.buffer(2.0) - floor, x, y)[..., None], np.maximum(-z, z - CEILING))
    for polygon, bottom, top in solids:
        inside = np.minimum(np.minimum(z - bottom, top - z), signed_depth(polygon, x, y)[..., None])
        occupancy = np.maximum(occupancy, inside)
    known = occupancy <= TRUNCATION
    if observed is not None:
        known &= observed(x[..., None], y[..., None], z)
    means = np.where(known, np.clip(occupancy, -TRUNCATION, TRUNCATION), np.asarray(prior.dense(prior.occupancy)))
    precision = np.where(known, OBSERVATIONS, np.asarray(prior.dense(prior.occupancy_precision)))
    noise = np.random.default_rng(0).uniform(0.0, 1.0, (*prior.shape, 3))
    colour = np.clip(0.5 + 4.0 * (gaussian_filter(noise, (2.0, 2.0, 2.0, 0.0)) - 0.5), 0.0, 1.0)
    learned = eqx.tree_at(
        lambda m: (m.occupancy_precision, m.colour, m.colour_precision),
        prior,
        tuple(prior.blocked(jnp.asarray(a, jnp.float32)) for a in (precision, colour, precision)),
    )
    return learned.with_occupancy(prior.blocked(jnp.asarray(means, jnp.float32)))


@st.composite
def grids(draw: st.DrawFn) -> np.ndarray:
    """Draw random occupancy, bool ``(nx, ny)``: up to 24 cells a side, from nearly empty to nearly full."""
    shape = draw(st.tuples(st.integers(3, 24), st.integers(3, 24)))
    share = draw(st.sampled_from([0.05, 0.2, 0.35, 0.5]))
    return np.random.default_rng(draw(st.integers(0, 2**32 - 1))).random(shape) < share


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
