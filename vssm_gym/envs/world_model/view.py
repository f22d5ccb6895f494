"""What imagined robots see: scans, depth images and RGB-D images of the belief, by the emission's law.

    scan_k = depth at column ``u_k = (k + 1/2) W / 64 - 1/2`` of the camera's horizontal plane, k = 0 (left) ... 63

Depths are z-depths, m; 0 = no reading. The camera stands upright, so a ray of the horizontal plane stays at its height:
the trilinear field there is bilinear in x and y, and a scan in that slice is what the emission renders, as far as its
table of lines tells (:mod:`vssm_gym.envs.world_model.lines`). Images are traced in the box of the map that was observed
at all, exactly.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.camera import Camera
from vssm_gym.emission import STEP
from vssm_gym.envs.world_model.cones import block_starts
from vssm_gym.envs.world_model.config import BEAMS
from vssm_gym.envs.world_model.lines import Lines, scan_depths
from vssm_gym.envs.world_model.rays import Coordinates, RayField, Rays, rays_of, surface
from vssm_gym.voxel_map import OBSERVED_PRECISION, VoxelMap

SLICE_FINE, BOX_FINE = 4, 1  # pieces a cell
AT_ONCE = 4  # robots whose images are traced together on a CPU: their rays fit its cache


class View(eqx.Module):
    """A camera on robots in one or several maps; see the module."""

    field: RayField
    lines: Lines | None  # of a scan
    colour: Float[Array, "cells 3"] | None  # of the box's cells, (maps, *shape) in C order
    across: Float[Array, "width"]  # of pixel columns: camera x a metre of z-depth, to the right
    down: Float[Array, "height"]  # of rows; of a scan one zero
    forward: float = eqx.field(static=True)  # m, of the camera before the robot's origin
    height: float = eqx.field(static=True)  # m above the floor
    max_depth: float = eqx.field(static=True)  # m

    @classmethod
    def scan(cls, maps: list[VoxelMap], camera: Camera, T_body_cam: np.ndarray, max_depth: float) -> "View":
        """64 rays."""
        height = float(T_body_cam[2, 3])
        low, high = _observed_box(maps[0])
        field = _cut(maps, low, high, height)
        columns = (np.arange(BEAMS) + 0.5) * camera.width / BEAMS - 0.5
        across = jnp.asarray((columns - camera.cx) / camera.fx, jnp.float32)
        return cls(field, Lines.of(field), None, across, jnp.zeros(1), float(T_body_cam[0, 3]), height, max_depth)

    @classmethod
    def images(
        cls, maps: list[VoxelMap], camera: Camera, T_body_cam: np.ndarray, max_depth: float, colour: bool
    ) -> "View":
        """Depth images, with colour or without."""
        low, high = _observed_box(maps[0])
        field = _cut(maps, low, high, None)
        colours = None
        if colour:
            p_world = _centres(maps[0], low, high)
            colours = jnp.concatenate([m.colour_at(p_world).reshape(-1, 3) for m in maps])
        across = jnp.asarray((np.arange(camera.width) - camera.cx) / camera.fx, jnp.float32)
        down = jnp.asarray((np.arange(camera.height) - camera.cy) / camera.fy, jnp.float32)
        forward, height = float(T_body_cam[0, 3]), float(T_body_cam[2, 3])
        return cls(field, None, colours, across, down, forward, height, max_depth)

    def __call__(self, which: Int[Array, "n"], planar: Float[Array, "n 3"]) -> dict[str, Array]:
        """``scan (n, 64)``, or ``depth (n, height, width)`` and perhaps ``rgb`` uint8 of robots at ``planar``."""
        n, size = planar.shape[0], (len(self.down), len(self.across))
        if self.lines is not None:
            *ways, angle = self._cast(planar, self.across)
            each = jnp.repeat(which, BEAMS)
            return {"scan": scan_depths(self.field, self.lines, each, *ways, angle, self.max_depth).reshape(n, BEAMS)}
        if n > AT_ONCE and jax.default_backend() == "cpu":
            fill = lambda a: jnp.pad(a, [(0, -n % AT_ONCE), *[(0, 0)] * (a.ndim - 1)])
            parts = (fill(which).reshape(-1, AT_ONCE), fill(planar).reshape(-1, AT_ONCE, 3))
            depth, rgb = jax.lax.map(lambda part: self._pixels(*part), parts)
        else:
            depth, rgb = self._pixels(which, planar)
        images = {"depth": depth.reshape(-1, *size)[:n]}
        if rgb is not None:
            images["rgb"] = jnp.round(255.0 * jnp.clip(rgb, 0.0, 1.0)).astype(jnp.uint8).reshape(-1, *size, 3)[:n]
        return images

    def _pixels(self, which: Array, planar: Array) -> tuple[Array, Array | None]:
        """Depths (rays,) of all pixels of all robots, and colours (rays, 3) where there are such."""

        def cast(across: Array, down: Array) -> tuple[Rays, Array]:
            centre, direction, _ = self._cast(planar, across, down)
            each = jnp.repeat(which, len(across) * len(down))
            return rays_of(self.field, each, centre, direction, self.max_depth)

        rays, k = cast(self.across, self.down)
        k = jnp.maximum(k, block_starts(self.field, cast, self.across, self.down, len(which)))
        depth = STEP * self.field.voxel_size * surface(self.field, rays, k)
        if self.colour is None:
            return depth, None
        centre, direction, _ = self._cast(planar, self.across, self.down)
        at = [c + d * depth for c, d in zip(centre, direction, strict=True)]
        each = jnp.repeat(which, len(self.across) * len(self.down))
        return depth, jnp.where((depth > 0.0)[:, None], self._colour_at(each, at), 0.0)

    def _cast(self, planar: Array, across: Array, down: Array | None = None) -> tuple[Coordinates, Coordinates, Array]:
        """Where rays start (m), one metre of z-depth along them, and their angles in the world (rad), each (rays,).

        Of all robots' pixels in these columns and rows, rows first; without rows in the horizontal plane alone.
        """
        n, per = planar.shape[0], len(across) * (1 if down is None else len(down))
        right = jnp.tile(across, per // len(across))
        c, s = jnp.cos(planar[:, 2, None]), jnp.sin(planar[:, 2, None])
        spread = lambda a: jnp.broadcast_to(a, (n, per)).reshape(-1)
        x, y = planar[:, 0, None] + self.forward * c, planar[:, 1, None] + self.forward * s
        centre, direction = (spread(x), spread(y)), (spread(c + s * right), spread(s - c * right))
        angle = spread(planar[:, 2, None] - jnp.arctan(right))
        if down is None:
            return centre, direction, angle
        height = jnp.full(n * per, self.height)
        return (*centre, height), (*direction, -spread(jnp.repeat(down, len(across))[None])), angle

    def _colour_at(self, which: Array, p_world: list[Array]) -> Float[Array, "rays 3"]:
        """Trilinear colour, as the map's own."""
        assert self.colour is not None
        *strides, per_map = self.field.strides()
        low, weights, offsets = which * per_map, [jnp.ones_like(p_world[0])], [0]
        for p, o, n, stride in zip(p_world, self.field.origin, self.field.shape, strides, strict=True):
            g = (p - o) / self.field.voxel_size
            cell = jnp.clip(jnp.floor(g), 0.0, n - 2.0)
            low += cell.astype(jnp.int32) * stride
            weights = [w * f for w in weights for f in (1.0 - (g - cell), g - cell)]
            offsets = [o_ + more for o_ in offsets for more in (0, stride)]
        corners = (self.colour.at[low + offset].get(mode="promise_in_bounds") for offset in offsets)
        return sum(w[:, None] * corner for w, corner in zip(weights, corners, strict=True))  # type: ignore[return-value]


def _observed_box(m: VoxelMap) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and one past the highest cell of the map that was observed, and one around them; ``(3,)`` each."""
    seen = np.asarray(m.dense(m.occupancy_precision)).reshape(m.shape) > OBSERVED_PRECISION
    low, high = [], []
    for axis in range(3):
        index = np.flatnonzero(seen.any(axis=tuple(a for a in range(3) if a != axis)))
        first, last = (0, seen.shape[axis] - 1) if len(index) == 0 else (int(index[0]), int(index[-1]))
        low.append(max(0, first - 1))
        high.append(min(seen.shape[axis], last + 2))
    return np.array(low), np.array(high)


def _centres(m: VoxelMap, low: np.ndarray, high: np.ndarray, height: float | None = None) -> Float[Array, "*cells 3"]:
    """World positions of the box's cell centres, or of those of its columns at ``height`` m."""
    axes = [float(m.origin[a]) + float(m.voxel_size) * np.arange(low[a], high[a]) for a in range(3)]
    if height is not None:
        axes[2] = np.array([height])
    return jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), jnp.float32)


def _cut(maps: list[VoxelMap], low: np.ndarray, high: np.ndarray, height: float | None) -> RayField:
    """The observed box of the maps, or the slice of it at ``height`` m."""
    m, dims = maps[0], 2 if height is not None else 3
    p_world = _centres(m, low, high, height)
    occupancy = np.stack([np.asarray(_occupancy(one, p_world)) for one in maps])
    occupancy = occupancy[..., 0] if dims == 2 else occupancy
    origin = (np.asarray(m.origin) + float(m.voxel_size) * low)[:dims]
    return RayField.cut(occupancy, origin, float(m.voxel_size), SLICE_FINE if dims == 2 else BOX_FINE)


# A point on the grid's last cell centre counts as outside where rounding puts it there: nudged in by 1e-4 cells.
@jax.jit
def _occupancy(m: VoxelMap, p_world: Array) -> Array:
    low, high = m.origin, m.origin + m.voxel_size * (jnp.array(m.shape) - 1.0)
    slack = 1e-4 * m.voxel_size
    return m.occupancy_at(jnp.clip(p_world, low + slack, high - slack))
