"""The closed-form map update: ``q_t(M) ∝ q_t-1(M) q(M | x_t, z_t)`` (SPEC 3, step 5; PRISM, section 3).

A posed depth image is a Gaussian observation, std 1, of every cell between the camera and a truncation band behind the
surface: ``sdf = clip(d_obs(pi(p)) - z_cam(p), -trunc, trunc)``, occupancy ``-sdf``. Precisions add and the mean is the
precision-weighted average: the update of Curless and Levoy read as Bayes. Colour is observed only within the band: free
space has no colour, and a cell just before the surface must not remember the wall behind.

Cells are updated in whole blocks. Blocks that the image can reach are found by bounding spheres against a pyramid of
largest depths, listed, and processed in chunks by a loop with a dynamic trip count, so the cost follows what is seen.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vssm_gym import empty_space
from vssm_gym.camera import Camera
from vssm_gym.emission import TAU
from vssm_gym.empty_space import BLOCK, EmptySpace, block_coordinates
from vssm_gym.geometry import inverse
from vssm_gym.voxel_map import VoxelMap

CHUNK = 64  # blocks a loop turn: wide enough to vectorise, narrow enough to waste little on the last turn

_INNER = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)  # cells of a block


@dataclass(frozen=True)
class MapUpdateConfig:
    """How an image updates the map."""

    truncation: float = 2.0  # voxels behind the surface; 4 for noisy stereo depth (SPEC 3)
    std: float = 1.0  # of the observation of occupancy (m) and of colour
    min_depth: float = 0.05  # m
    max_depth: float = 8.0  # m; farther readings are left out


def depth_ceilings(depth: Float[Array, "height width"]) -> list[Array]:
    """A pyramid of largest depths: level ``l`` holds the maximum over ``2^l x 2^l`` pixels, zero-padded."""
    levels = [depth]
    while max(levels[-1].shape) > 1:
        d = levels[-1]
        d = jnp.pad(d, ((0, d.shape[0] % 2), (0, d.shape[1] % 2)))
        levels.append(jnp.max(d.reshape(d.shape[0] // 2, 2, d.shape[1] // 2, 2), axis=(1, 3)))
    return levels


def blocks_in_view(
    m: VoxelMap, depth: Array, T_cam_world: Array, camera: Camera, config: MapUpdateConfig
) -> Bool[Array, "blocks"]:
    """Blocks that may hold a cell to update: a bounding sphere test that errs on the side of yes."""
    ids = jnp.arange(m.occupancy.shape[0])
    centre_world = (block_coordinates(ids, m.blocks) * BLOCK + 0.5 * (BLOCK - 1)) * m.voxel_size + m.origin
    radius = 0.5 * (BLOCK - 1) * jnp.sqrt(3.0) * m.voxel_size
    truncation = config.truncation * m.voxel_size
    centre = centre_world @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    z = centre[:, 2]
    near = jnp.maximum(z - radius, 1e-3)
    uv, _ = camera.project(jnp.where((z > 1e-3)[:, None], centre, jnp.asarray([0.0, 0.0, 1.0])))
    in_frustum = z > -radius
    fx, fy = jnp.asarray(camera.fx), jnp.asarray(camera.fy)
    for f, c, pixels, axis in ((fx, camera.cx, camera.width, 0), (fy, camera.cy, camera.height, 1)):
        for inward, border in ((f, c + 0.5), (-f, pixels - 0.5 - c)):  # normals (inward, border) of two side planes
            distance = (inward * centre[:, axis] + border * z) / jnp.hypot(inward, border)
            in_frustum &= distance >= -radius
    # Radius of the sphere's image: distance over nearest depth, plus the slope of the view towards the corner.
    slope = jnp.maximum(jnp.abs(centre[:, 0]), jnp.abs(centre[:, 1])) / jnp.maximum(z, 1e-3)
    spread = jnp.maximum(fx, fy) * radius / near * (1.0 + slope) + 1.0
    size = jnp.asarray([camera.width, camera.height])
    low, high = jnp.clip(uv - spread[:, None], 0, size - 1), jnp.clip(uv + spread[:, None], 0, size - 1)
    # The pyramid level on which the box spans at most two texels a side; four look-ups then cover it.
    levels = depth_ceilings(depth)
    width = jnp.max(high - low, axis=-1)
    level = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(width, 1.0))).astype(jnp.int32), 0, len(levels) - 1)
    widths = jnp.asarray([a.shape[1] for a in levels])
    starts = jnp.asarray(np.cumsum([0] + [a.size for a in levels[:-1]]))
    flat = jnp.concatenate([a.reshape(-1) for a in levels])
    a = low.astype(jnp.int32) >> level[:, None]
    b = high.astype(jnp.int32) >> level[:, None]

    def texel(u, v):
        return flat[starts[level] + v * widths[level] + u]

    ceiling = jnp.maximum(
        jnp.maximum(texel(a[:, 0], a[:, 1]), texel(b[:, 0], a[:, 1])),
        jnp.maximum(texel(a[:, 0], b[:, 1]), texel(b[:, 0], b[:, 1])),
    )
    ceiling = jnp.where(z > radius, ceiling, jnp.max(depth))  # a sphere around the camera plane has no bounded image
    return in_frustum & (z - radius <= ceiling + truncation) & (z + radius > config.min_depth) & (ceiling > 0.0)


def observe_cells(
    p_cam: Float[Array, "3 *batch"],
    voxel_size: Array,
    depth: Float[Array, "height width"],
    rgb: Float[Array, "height width 3"],
    camera: Camera,
    config: MapUpdateConfig,
) -> tuple[Array, Array, Array, list[Array]]:
    """The Gaussian observation that an image makes of cells at camera-frame points.

    Returns:
        Precision of occupancy, occupancy (m), precision of colour, and the three colour channels; each ``(*batch)``.
    """
    x, y, z = p_cam
    ahead = z > config.min_depth
    inverse_z = 1.0 / jnp.where(ahead, z, 1.0)
    u = jnp.round(x * inverse_z * camera.fx + camera.cx).astype(jnp.int32)
    v = jnp.round(y * inverse_z * camera.fy + camera.cy).astype(jnp.int32)
    inside = ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = jnp.where(inside, v * camera.width + u, 0)
    d = depth.reshape(-1).at[pixel].get(mode="promise_in_bounds")
    sdf = d - z
    truncation = config.truncation * voxel_size
    seen = inside & (d > config.min_depth) & (sdf > -truncation)
    weight = config.std**-2
    occupancy = -jnp.clip(sdf, -truncation, truncation)
    colour = [rgb[..., c].reshape(-1).at[pixel].get(mode="promise_in_bounds") for c in range(3)]
    return weight * seen, occupancy, weight * (seen & (sdf < truncation)), colour


def fuse(mean: Array, precision: Array, observed: Array, weight: Array) -> tuple[Array, Array]:
    """``N(mean, 1/precision) N(observed, 1/weight)``: the product's mean and precision (weight 0 changes nothing)."""
    total = precision + weight
    return mean + weight / total * (observed - mean), total


def _chunks(mask: Bool[Array, "blocks"]) -> tuple[Array, Array]:
    """The numbers of the set blocks, padded to whole chunks with one past the last, and how many chunks they fill."""
    n = mask.shape[0]
    # A list as long as the grid cannot overflow: an overflow would silently leave blocks out.
    (ids,) = jnp.nonzero(mask, size=-(-n // CHUNK) * CHUNK, fill_value=n)
    return ids, (jnp.sum(mask) + CHUNK - 1) // CHUNK


@partial(jax.jit, static_argnums=5, donate_argnums=0)
def update(
    m: VoxelMap,
    depth: Float[Array, "height width"],
    rgb: Float[Array, "height width 3"],
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    config: MapUpdateConfig = MapUpdateConfig(),
) -> VoxelMap:
    """``q(M) q(M | x, z)``: the map after one posed image. The map passed in is consumed (its buffers are reused).

    Args:
        m: Map belief; donated.
        depth: ``(height, width)`` z-depth, m; 0 = no reading.
        rgb: ``(height, width, 3)`` in [0, 1].
        T_world_cam: ``(4, 4)`` camera pose.
        camera: Intrinsics.
        config: Truncation, std and range.

    Returns:
        The map belief, its empty-space index following the new means.
    """
    depth = jnp.where(jnp.isfinite(depth) & (depth <= config.max_depth), depth, 0.0)
    T_cam_world = inverse(T_world_cam)
    n = m.occupancy.shape[0]
    in_view = blocks_in_view(m, depth, T_cam_world, camera, config)
    ids, count = _chunks(in_view)
    # p_cam of a cell is its block's first corner plus its place in the block, both rotated once: no product per cell.
    corner_cam = (block_coordinates(jnp.arange(n), m.blocks) * BLOCK * m.voxel_size + m.origin) @ T_cam_world[:3, :3].T
    corner_cam = corner_cam + T_cam_world[:3, 3]
    inner_cam = (_INNER * m.voxel_size) @ T_cam_world[:3, :3].T

    def revise(i, belief):
        occupancy, occupancy_precision, colour, colour_precision, changed = belief
        chunk = jax.lax.dynamic_slice(ids, (i * CHUNK,), (CHUNK,))
        row = jnp.minimum(chunk, n - 1)
        p_cam = corner_cam[row].T[:, :, None] + inner_cam.T[:, None, :]
        w_o, o, w_c, c = observe_cells(p_cam, m.voxel_size, depth, rgb, camera, config)
        before = occupancy[row]
        new_o, new_po = fuse(before, occupancy_precision[row], o, w_o)
        new_c, _ = fuse(colour[row], colour_precision[row][:, None], jnp.stack(c, axis=1), w_c[:, None])
        new_pc = colour_precision[row] + w_c
        flipped = jnp.any((before > TAU) != (new_o > TAU), axis=-1)
        return (
            occupancy.at[chunk].set(new_o, mode="drop"),
            occupancy_precision.at[chunk].set(new_po, mode="drop"),
            colour.at[chunk].set(new_c, mode="drop"),
            colour_precision.at[chunk].set(new_pc, mode="drop"),
            changed.at[chunk].set(flipped, mode="drop"),
        )

    belief = (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision, jnp.zeros(n, bool))
    occupancy, occupancy_precision, colour, colour_precision, changed = jax.lax.fori_loop(0, count, revise, belief)
    return VoxelMap(
        occupancy=occupancy,
        occupancy_precision=occupancy_precision,
        colour=colour,
        colour_precision=colour_precision,
        empty=_refresh(m.empty, occupancy, changed, m.blocks),
        origin=m.origin,
        voxel_size=m.voxel_size,
        blocks=m.blocks,
    )


def _refresh(empty: EmptySpace, occupancy: Array, changed: Array, blocks: tuple[int, int, int]) -> EmptySpace:
    """The index after cells of the ``changed`` blocks crossed the threshold."""
    # The cubes of a block read the first layer of the next ones, so the blocks before a changed one change too.
    dirty = changed.reshape(blocks)
    for axis in range(3):
        following = jnp.pad(dirty, [(0, int(a == axis)) for a in range(3)])
        dirty = dirty | jax.lax.slice_in_dim(following, 1, blocks[axis] + 1, axis=axis)
    ids, count = _chunks(dirty.reshape(-1))
    n = occupancy.shape[0]

    def relevel(i, level):
        chunk = jax.lax.dynamic_slice(ids, (i * CHUNK,), (CHUNK,))
        rows = empty_space.block_levels(occupancy, jnp.minimum(chunk, n - 1), blocks, TAU)
        return level.at[chunk].set(rows, mode="drop")

    level = jax.lax.fori_loop(0, count, relevel, empty.level)
    return EmptySpace(level, empty_space.empty_rings(level, blocks))
