"""List the blocks that an image can update: ``z_near(block) <= max depth of the pixels it covers + truncation``.

Boxes are bounded by spheres, and the pixels that a sphere may cover are read from a pyramid of largest depths. Groups
of blocks are tested first, then only the blocks of groups that pass: the cost depends on what is in view, not on the
size of the grid.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.maps.block_table import BLOCK, block_coordinates, block_number
from vssm_gym.maps.compaction import FLAGS_A_TURN, append, empty_list, first_set
from vssm_gym.maps.voxel_map import VoxelMap

GROUP_EDGE = 4  # blocks along the edge of a group

_IN_GROUP = np.stack(np.meshgrid(*[np.arange(GROUP_EDGE)] * 3, indexing="ij"), -1).reshape(-1, 3)  # blocks of a group


def depth_ceilings(depth: Float[Array, "height width"]) -> list[Array]:
    """Build a pyramid of largest depths: level ``l`` is the maximum over ``2^l x 2^l`` pixels, zero-padded."""
    levels = [depth]
    while max(levels[-1].shape) > 1:
        d = levels[-1]
        d = jnp.pad(d, ((0, d.shape[0] % 2), (0, d.shape[1] % 2)))
        levels.append(jnp.max(d.reshape(d.shape[0] // 2, 2, d.shape[1] // 2, 2), axis=(1, 3)))
    return levels


def _bound(
    centre_world: tuple[Array, Array, Array],
    radius: Array,
    depth: Array,
    T_cam_world: Array,
    camera: Camera,
    truncation: Array,
    min_depth: float,
) -> Bool[Array, "n"]:
    """Test conservatively which spheres may hold a cell to update. ``depth`` is the base of the pyramid."""
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    x, y, z = (sum(R[a, b] * centre_world[b] for b in range(3)) + t[a] for a in range(3))
    near = jnp.maximum(z - radius, 1e-3)
    safe = jnp.where(z > 1e-3, z, 1.0)
    in_frustum = z > -radius
    fx, fy = jnp.asarray(camera.fx), jnp.asarray(camera.fy)
    for f, c, pixels, p in ((fx, camera.cx, camera.width, x), (fy, camera.cy, camera.height, y)):
        for inward, border in ((f, c + 0.5), (-f, pixels - 0.5 - c)):  # normals (inward, border) of two side planes
            in_frustum &= (inward * p + border * z) / jnp.hypot(inward, border) >= -radius
    # Radius of the sphere's image: distance over nearest depth, plus the slope of the view towards the corner.
    slope = jnp.maximum(jnp.abs(x), jnp.abs(y)) / jnp.maximum(z, 1e-3)
    spread = jnp.maximum(fx, fy) * radius / near * (1.0 + slope) + 1.0
    u, v = x / safe * fx + camera.cx, y / safe * fy + camera.cy
    u0, u1 = (jnp.clip(u + s * spread, 0, camera.width - 1) for s in (-1, 1))
    v0, v1 = (jnp.clip(v + s * spread, 0, camera.height - 1) for s in (-1, 1))
    # The pyramid level on which the box spans at most two texels a side; four look-ups then cover it.
    levels = depth_ceilings(depth)
    extent = jnp.maximum(u1 - u0, v1 - v0)
    level = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(extent, 1.0))).astype(jnp.int32), 0, len(levels) - 1)
    width = jnp.asarray([a.shape[1] for a in levels])[level]
    start = jnp.asarray(np.cumsum([0] + [a.size for a in levels[:-1]]))[level]
    flat = jnp.concatenate([a.reshape(-1) for a in levels])
    columns, lines = ([a.astype(jnp.int32) >> level for a in ab] for ab in ((u0, u1), (v0, v1)))
    texels = [flat[start + b * width + a] for a in columns for b in lines]
    ceiling = jnp.maximum(jnp.maximum(texels[0], texels[1]), jnp.maximum(texels[2], texels[3]))
    ceiling = jnp.where(z > radius, ceiling, jnp.max(depth))  # a sphere around the camera plane has no bounded image
    return in_frustum & (z - radius <= ceiling + truncation) & (z + radius > min_depth) & (ceiling > 0.0)


def blocks_in_view(
    m: VoxelMap, depth: Array, T_cam_world: Float[Array, "samples 4 4"], camera: Camera, config: MapUpdateConfig
) -> tuple[Array, Array]:
    """List the blocks that may hold a cell to update from any of the poses: numbers, then fill; and their count.

    Groups of blocks are tested first, then only the blocks of groups that pass, so that a larger grid costs little
    more.
    """
    truncation = config.truncation * m.voxel_size

    def may_see(first, cells):  # boxes of cells**3 whose first cells are at block coordinates ``first``
        middle = [(b * BLOCK + 0.5 * (cells - 1)) * m.voxel_size + m.origin[a] for a, b in enumerate(first)]
        radius = 0.5 * (cells - 1) * jnp.sqrt(3.0) * m.voxel_size
        seen = [
            _bound((middle[0], middle[1], middle[2]), radius, depth, T, camera, truncation, config.min_depth)
            for T in T_cam_world
        ]
        return jnp.any(jnp.stack(seen), axis=0)

    groups = tuple(-(-b // GROUP_EDGE) for b in m.blocks)
    n = groups[0] * groups[1] * groups[2]
    coordinates = block_coordinates(jnp.arange(n), groups)
    busy = may_see([GROUP_EDGE * g for g in coordinates], GROUP_EDGE * BLOCK)
    at_once = FLAGS_A_TURN // GROUP_EDGE**3
    order = jnp.pad(first_set(busy, n), (0, at_once), constant_values=n)

    def turn(i, listed):
        group = jax.lax.dynamic_slice(order, (i * at_once,), (at_once,))
        block = [
            (GROUP_EDGE * g[:, None] + _IN_GROUP[:, a]).reshape(-1)
            for a, g in enumerate(block_coordinates(jnp.minimum(group, n - 1), groups))
        ]
        inside = jnp.repeat(group < n, GROUP_EDGE**3)
        for b, count in zip(block, m.blocks, strict=True):
            inside &= b < count
        number = block_number(block, m.blocks)
        return append(listed, number, inside & may_see(block, BLOCK))

    turns = -(-jnp.sum(busy, dtype=jnp.int32) // at_once)
    return jax.lax.fori_loop(0, turns, turn, empty_list(m.blocks[0] * m.blocks[1] * m.blocks[2]))
