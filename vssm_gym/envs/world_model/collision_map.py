"""Map the obstacles of imagined robots: the belief's columns in the robot's height band, as signed clearance.

    c(x, y) = signed distance (m) to the nearest column that is occupied, and with ``unknown="blocked"`` to the nearest
              that was barely observed, too; bilinear between nodes 2.5 cm apart

Planners use the same columns and distances (:mod:`vssm_gym.maps.columns`). The grid covers the observed free columns;
its rim is blocked, so that no robot leaves what is known.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.envs.world_model.config import SOURCE
from vssm_gym.errors import InputError
from vssm_gym.maps.columns import BODY_HEIGHTS, OBSERVED_SHARE, level_distance, observed_columns
from vssm_gym.maps.voxel_map import VoxelMap

NODE_SPACING = 0.025  # m, between the nodes of the grid of clearances
PATH_PIECES = 4  # of one step's path: each shorter than the footprint's radius, so that no wall is jumped
PUSHES = 2  # out of an obstacle, after each piece: in a corner the first push may end in the other wall


class CollisionMap(eqx.Module):
    """Hold the clearance of one or several maps on one grid; see the module."""

    clearance: Float[Array, "nodes"]  # (maps, nx, ny) in C order, m
    known: Bool[Array, "columns"]  # (nx, ny) in C order
    origin: Float[Array, "2"]  # world position of node (0, 0), m
    shape: tuple[int, int] = eqx.field(static=True)
    resolution: float = eqx.field(static=True)  # m

    @classmethod
    def of(cls, maps: list[VoxelMap], height: float, unknown: str) -> "CollisionMap":
        """Build the map of one belief and samples of it, for a body that is ``height`` m tall.

        Raises :class:`InputError` for a map that shows no free floor.
        """
        columns = [observed_columns(m, BODY_HEIGHTS[0], height, NODE_SPACING) for m in maps]
        known = columns[0][1] >= OBSERVED_SHARE  # precisions are the belief's in every sample
        free = np.argwhere(known & (columns[0][0] <= 0.0))
        if len(free) == 0:
            raise InputError(SOURCE, "map", f"free floor observed between {BODY_HEIGHTS[0]} and {height} m; found none")
        low, high = np.maximum(free.min(axis=0) - 1, 0), free.max(axis=0) + 2
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        clearance = []
        for top, _ in columns:
            blocked = ~known & (top <= 0.0)
            # An unobserved column has no surface to interpolate: half a cell is the unbiased place of its border.
            depth = np.where(blocked, 0.5 * NODE_SPACING if unknown == "blocked" else -NODE_SPACING, top)[window]
            rim = np.pad(np.zeros(np.subtract(depth.shape, 2), bool), 1, constant_values=True)
            depth = np.where(rim & (depth <= 0.0), NODE_SPACING, depth)
            clearance.append(level_distance(depth, NODE_SPACING))
        nx, ny = clearance[0].shape
        origin = maps[0].bounds[0, :2] + low * NODE_SPACING
        flat = jnp.asarray(np.stack(clearance).reshape(-1), jnp.float32)
        known_ = jnp.asarray(known[window].reshape(-1))
        return cls(flat, known_, jnp.asarray(origin, jnp.float32), (nx, ny), NODE_SPACING)

    def mean(self) -> Float[np.ndarray, "nx ny"]:
        """Return the clearance ``(nx, ny)`` in the first map, m."""
        nx, ny = self.shape
        return np.asarray(self.clearance).reshape(-1, nx, ny)[0]

    def at(self, which: Int[Array, "*batch"], x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the clearance (m) and its slope along x and y at world points in map ``which``.

        Points beyond the grid take the values of its rim.
        """
        nx, ny = self.shape
        u = jnp.clip((x - self.origin[0]) / self.resolution, 0.0, nx - 1.0)
        v = jnp.clip((y - self.origin[1]) / self.resolution, 0.0, ny - 1.0)
        i, j = jnp.minimum(u.astype(jnp.int32), nx - 2), jnp.minimum(v.astype(jnp.int32), ny - 2)
        a, b = u - i, v - j
        low = (which * nx + i) * ny + j
        c00, c01, c10, c11 = (
            self.clearance.at[low + offset].get(mode="promise_in_bounds") for offset in (0, 1, ny, ny + 1)
        )
        left, right = c00 + b * (c01 - c00), c10 + b * (c11 - c10)
        slope_y = (1.0 - a) * (c01 - c00) + a * (c11 - c10)
        return left + a * (right - left), (right - left) / self.resolution, slope_y / self.resolution

    def known_at(self, x: Array, y: Array) -> Bool[Array, "*batch"]:
        """Return True where the column nearest to each world point was observed."""
        nx, ny = self.shape
        i = jnp.clip(((x - self.origin[0]) / self.resolution + 0.5).astype(jnp.int32), 0, nx - 1)
        j = jnp.clip(((y - self.origin[1]) / self.resolution + 0.5).astype(jnp.int32), 0, ny - 1)
        return self.known.at[i * ny + j].get(mode="promise_in_bounds")


def slide(
    collision_map: CollisionMap, which: Int[Array, "n"], x: Array, y: Array, dx: Array, dy: Array, radius: float
) -> tuple[Array, Array, Bool[Array, "n"]]:
    """Move discs by ``(dx, dy)`` m along obstacles; return where each ends and whether it collided.

    After each piece of the path a disc is pushed out of what it overlaps along the clearance's slope, which keeps the
    motion along the wall: contacts are frictionless, as in the simulator.
    """

    def push(i, carry):
        x, y, collided = carry
        further = (i % PUSHES == 0) / PATH_PIECES
        x, y = x + further * dx, y + further * dy
        clearance, slope_x, slope_y = collision_map.at(which, x, y)
        lacking = jnp.maximum(radius - clearance, 0.0)
        steep = jnp.maximum(slope_x**2 + slope_y**2, 0.25)  # flat on ridges: never more than twice what lacks
        return x + lacking * slope_x / steep, y + lacking * slope_y / steep, collided | (lacking > 0.0)

    # A loop: written out, the compiler works out again for each of the three all that leads to them, 3^8 times.
    return jax.lax.fori_loop(0, PATH_PIECES * PUSHES, push, (x, y, jnp.zeros(x.shape, bool)))


def disc_clearance(
    collision_map: CollisionMap, which: Int[Array, "n"], x: Array, y: Array, radius: float
) -> Float[Array, "n"]:
    """Return the least clearance beyond ``radius`` among discs ``(discs, n)`` of a body, m; negative: one overlaps."""
    clearance, _, _ = collision_map.at(jnp.broadcast_to(which, x.shape), x, y)
    return jnp.min(clearance, axis=0) - radius


mean_clearance = jax.jit(lambda collision_map, x, y: collision_map.at(jnp.zeros(x.shape, jnp.int32), x, y)[0])
