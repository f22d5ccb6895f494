"""Render scans, depth images and RGB-D images of the belief for imagined robots, by the emission model.

    scan_k = depth at column ``u_k = (k + 1/2) W / 64 - 1/2`` of the camera's horizontal plane, k = 0 (left) ... 63

Depths are z-depths, m; 0 = no reading. The camera is upright, so a ray of the horizontal plane stays at its height: the
trilinear field there is bilinear in x and y, and a scan in that slice is what the emission renders, up to the error of
its scan table (:mod:`vssm_gym.envs.world_model.scan_table`). Images are traced exactly, in the observed box of the map.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.envs.world_model.column_bounds import ColumnBounds
from vssm_gym.envs.world_model.rays import Coordinates, RayField, Rays, crossing, narrowed, rays_of, surface
from vssm_gym.envs.world_model.scan_table import ScanTable, scan_depths
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.scan import BEAMS
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.model.emission import STEP

SLICE_FINE, BOX_FINE = 4, 1  # pieces a cell
ROBOTS_AT_ONCE = 4  # robots whose images are traced together on a CPU: their rays fit in its cache


class ImaginedCamera(eqx.Module):
    """Hold a camera and the fields of one or several maps that it renders; see the module."""

    field: RayField
    scan_table: ScanTable | None  # of a scan
    column_bounds: ColumnBounds | None  # of images
    colour: Float[Array, "cells 3"] | None  # of the box's cells, (maps, *shape) in C order
    across: Float[Array, "width"]  # of pixel columns: camera x a metre of z-depth, to the right
    down: Float[Array, "height"]  # of rows; of a scan one zero
    forward: float = eqx.field(static=True)  # m, of the camera before the robot's origin
    height: float = eqx.field(static=True)  # m above the floor
    max_depth: float = eqx.field(static=True)  # m

    @classmethod
    def scan(cls, maps: list[VoxelMap], camera: Camera, T_body_cam: np.ndarray, max_depth: float) -> "ImaginedCamera":
        """Build a camera that renders scans of 64 rays."""
        height = float(T_body_cam[2, 3])
        low, high = _observed_box(maps[0])
        field = _cut(maps, low, high, height)
        columns = (np.arange(BEAMS) + 0.5) * camera.width / BEAMS - 0.5
        across = jnp.asarray((columns - camera.cx) / camera.fx, jnp.float32)
        return cls(
            field, ScanTable.of(field), None, None, across, jnp.zeros(1), float(T_body_cam[0, 3]), height, max_depth
        )

    @classmethod
    def images(
        cls, maps: list[VoxelMap], camera: Camera, T_body_cam: np.ndarray, max_depth: float, colour: bool
    ) -> "ImaginedCamera":
        """Build a camera that renders depth images, with colour or without."""
        low, high = _observed_box(maps[0])
        field = _cut(maps, low, high, None)
        colours = None
        if colour:
            p_world = _centres(maps[0], low, high)
            colours = jnp.concatenate([m.colour_at(p_world).reshape(-1, 3) for m in maps])
        across = jnp.asarray((np.arange(camera.width) - camera.cx) / camera.fx, jnp.float32)
        down = jnp.asarray((np.arange(camera.height) - camera.cy) / camera.fy, jnp.float32)
        forward, height = float(T_body_cam[0, 3]), float(T_body_cam[2, 3])
        return cls(field, None, ColumnBounds.of(field, height), colours, across, down, forward, height, max_depth)

    def __call__(self, which: Int[Array, "n"], planar: Float[Array, "n 3"]) -> dict[str, Array]:
        """Render ``scan (n, 64)``, or ``depth (n, height, width)`` perhaps with ``rgb`` uint8, of robots."""
        if self.scan_table is None:
            return self._images(which, planar)
        (*cameras, heading), right, down = self._pixels([*self._cameras(planar), planar[:, 2]])
        centre, direction = self._cast(cameras, right, down)
        angle, each = heading - jnp.arctan(right), self._each(which)
        scan = scan_depths(self.field, self.scan_table, each, centre[:2], direction[:2], angle, self.max_depth)
        return {"scan": scan.reshape(-1, BEAMS)}

    def _images(self, which: Array, planar: Array) -> dict[str, Array]:
        n, rows, columns = len(which), len(self.down), len(self.across)
        at_once = min(n, ROBOTS_AT_ONCE) if jax.default_backend() == "cpu" else n
        fill = lambda a: jnp.pad(a, (0, -n % at_once))
        cameras = self._cameras(planar)  # here, because rays would each compute the cosine
        parts = jax.tree.map(lambda a: fill(a).reshape(-1, at_once), (which, cameras))
        depth, index, free = jax.lax.map(lambda part: self._begin(*part), parts)
        # The last rays of all parts are searched together: a pass costs about the same for ten as for a thousand.
        count = depth.shape[1]
        number = jnp.where(index < count, index + count * jnp.arange(len(index))[:, None], depth.size).reshape(-1)
        size = (len(index), rows, at_once, columns)
        part, row, camera, column = jnp.unravel_index(jnp.minimum(number, depth.size - 1), size)
        robot = jnp.minimum(part * at_once + camera, n - 1)
        rays, _ = self._rays(which[robot], [a[robot] for a in cameras], self.across[column], self.down[row])
        rays = eqx.tree_at(lambda r: r.last, rays, jnp.where(number < depth.size, rays.last, -1.0))
        rest = surface(self.field, rays, free.reshape(-1))
        depth = STEP * self.field.voxel_size * depth.reshape(-1).at[number].set(rest, mode="drop")

        def arrange(a: Array) -> Array:
            a = jnp.swapaxes(a.reshape(-1, rows, at_once, columns, *a.shape[2:]), 1, 2)
            return a.reshape(-1, rows, columns, *a.shape[4:])[:n]

        images = {"depth": arrange(depth.reshape(-1, count))}
        if self.colour is not None:
            rgb = jax.lax.map(lambda part: self._colours(*part), (*parts, depth.reshape(-1, count)))
            images["rgb"] = arrange(jnp.round(255.0 * jnp.clip(rgb, 0.0, 1.0)).astype(jnp.uint8))
        return images

    def _begin(self, which: Array, cameras: list[Array]) -> tuple[Array, Array, Array]:
        """Find the surfaces (samples) of all but a few rays; return also the others' numbers and free samples."""
        assert self.column_bounds is not None
        columns, right = len(self.across), jnp.tile(self.across, len(which))
        lines = self._rays(jnp.repeat(which, columns), [jnp.repeat(a, columns) for a in cameras], right, 0.0 * right)
        free = self.column_bounds.first_samples(self.field, *lines, self.down).reshape(-1)
        rays, first = self._rays(self._each(which), *self._pixels(cameras))
        found, index, _, rest = narrowed(self.field, rays, jnp.maximum(first, free), 0)
        return crossing(self.field, rays, found), index, rest

    def _colours(self, which: Array, cameras: list[Array], depth: Array) -> Float[Array, "rays 3"]:
        """Return the colours of the surfaces at z-depth ``depth``."""
        centre, direction = self._cast(*self._pixels(cameras))
        at = [c + d * depth for c, d in zip(centre, direction, strict=True)]
        return jnp.where((depth > 0.0)[:, None], self._colour_at(self._each(which), at), 0.0)

    def _cameras(self, planar: Array) -> list[Array]:
        """Return x, y (m), cosine and sine of the heading of each camera, ``(n,)`` each."""
        c, s = jnp.cos(planar[:, 2]), jnp.sin(planar[:, 2])
        return [planar[:, 0] + self.forward * c, planar[:, 1] + self.forward * s, c, s]

    def _pixels(self, cameras: list[Array]) -> tuple[list[Array], Array, Array]:
        """Return cameras, columns and rows of all pixels, ``(rays,)`` each: (rows, cameras, columns) in C order."""
        size = (len(self.down), len(cameras[0]), len(self.across))
        spread = lambda a: jnp.broadcast_to(a, size).reshape(-1)
        return [self._each(a) for a in cameras], spread(self.across), spread(self.down[:, None, None])

    def _each(self, of_cameras: Array) -> Array:
        """Repeat values of cameras for all pixels, in that order."""
        size = (len(self.down), len(of_cameras), len(self.across))
        return jnp.broadcast_to(of_cameras[:, None], size).reshape(-1)

    def _cast(self, cameras: list[Array], across: Array, down: Array) -> tuple[Coordinates, Coordinates]:
        """Return the starts of rays, m, and their vectors for one metre of z-depth."""
        x, y, c, s = cameras
        return (x, y, jnp.full_like(x, self.height)), (c + s * across, s - c * across, -down)

    def _rays(self, which: Array, cameras: list[Array], across: Array, down: Array) -> tuple[Rays, Array]:
        return rays_of(self.field, which, *self._cast(cameras, across, down), self.max_depth)

    def _colour_at(self, which: Array, p_world: list[Array]) -> Float[Array, "rays 3"]:
        """Interpolate the map's colour trilinearly."""
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
    """Return the lowest and one past the highest observed cell, with a margin of one cell; ``(3,)`` each."""
    seen = np.asarray(m.dense(m.occupancy_precision)).reshape(m.shape) > OBSERVED_PRECISION
    low, high = [], []
    for axis in range(3):
        index = np.flatnonzero(seen.any(axis=tuple(a for a in range(3) if a != axis)))
        first, last = (0, seen.shape[axis] - 1) if len(index) == 0 else (int(index[0]), int(index[-1]))
        low.append(max(0, first - 1))
        high.append(min(seen.shape[axis], last + 2))
    return np.array(low), np.array(high)


def _centres(m: VoxelMap, low: np.ndarray, high: np.ndarray, height: float | None = None) -> Float[Array, "*cells 3"]:
    """Return the world positions of the box's cell centres, or of its columns at ``height`` m."""
    axes = [float(m.origin[a]) + float(m.voxel_size) * np.arange(low[a], high[a]) for a in range(3)]
    if height is not None:
        axes[2] = np.array([height])
    return jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), jnp.float32)


def _cut(maps: list[VoxelMap], low: np.ndarray, high: np.ndarray, height: float | None) -> RayField:
    """Cut the observed box out of the maps, or its slice at ``height`` m."""
    m, dims = maps[0], 2 if height is not None else 3
    p_world = _centres(m, low, high, height)
    occupancy = np.stack([np.asarray(_occupancy(one, p_world)) for one in maps])
    occupancy = occupancy[..., 0] if dims == 2 else occupancy
    origin = (np.asarray(m.origin) + float(m.voxel_size) * low)[:dims]
    return RayField.cut(occupancy, origin, float(m.voxel_size), SLICE_FINE if dims == 2 else BOX_FINE)


# Rounding may put the last cell centre outside the grid; points are moved in by 1e-4 cells.
@jax.jit
def _occupancy(m: VoxelMap, p_world: Array) -> Array:
    low, high = m.origin, m.origin + m.voxel_size * (jnp.array(m.shape) - 1.0)
    slack = 1e-4 * m.voxel_size
    return m.occupancy_at(jnp.clip(p_world, low + slack, high - slack))
