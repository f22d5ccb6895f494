"""List the cells that a posed depth image observes, as bit sets per block, by the rule of the map update (eq. P35).

A cell is observed where ``d(pi(p)) - z(p) > -truncation`` (:mod:`vssm_gym.inference.mapping.observation`). Its gain
depends on the update's precision alone, not on what is measured, so a view is the set of its cells. Of the 512 cells of
a block a subset can stand for all: with ``every`` = 8 one cell in each row along z, at heights staggered so that every
plane of cells along the grid's axes has its share.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.voxel_map import VoxelMap

ROWS = BLOCK * BLOCK  # rows of cells along z in a block: one bit each in a word
DEPTH_TILES = 20  # along the image's width: largest depths, which tell blocks behind surfaces
SKEW = 5  # row (i, j) of a block starts with the cell at height (i + SKEW j) % every


class Grid(NamedTuple):
    """Hold where cells lie, as numbers that compiled code takes."""

    blocks: tuple[int, int, int]  # along x, y, z
    origin: tuple[float, float, float]  # world position of cell (0, 0, 0), m
    voxel: float  # m

    @classmethod
    def of(cls, m: VoxelMap) -> "Grid":
        """Return a map's grid."""
        x, y, z = (float(c) for c in m.origin)
        return cls(m.blocks, (x, y, z), float(m.voxel_size))


class Observed(NamedTuple):
    """Hold the cells observed from one view."""

    block: np.ndarray  # (n,) int64 numbers of the blocks in which a cell is observed
    words: np.ndarray  # (n, 8 / every) uint64: bit r of word s is cell s of row r = 8 i + j, as `heights` lists them


def heights(every: int) -> np.ndarray:
    """Return ``(8 / every, 64)`` int64: the height in its block of cell ``s`` of row ``r``."""
    i, j = np.divmod(np.arange(ROWS), BLOCK)
    return (i + SKEW * j) % every + every * np.arange(BLOCK // every)[:, None]


def observed(
    depth: np.ndarray, T_world_cam: np.ndarray, camera: Camera, grid: Grid, config: MapUpdateConfig, every: int
) -> list[Observed]:
    """List the cells that each image updates.

    Args:
        depth: ``(views, height, width)`` z-depth, m; no measurement where it is not in ``(min_depth, max_depth]``.
        T_world_cam: ``(views, 4, 4)`` camera poses.
        camera: intrinsics of the images.
        grid: of the map.
        config: of the map update.
        every: one cell in so many is tested: 1, 2, 4 or 8.
    """
    truncation = config.truncation * grid.voxel
    depth = np.where(depth <= config.max_depth, depth, np.float32(0.0))
    T_world_cam = np.asarray(T_world_cam, np.float64)
    T_cam_world, rows = np.ascontiguousarray(inverse(T_world_cam)), heights(every)
    (fx, _, cx), (_, fy, cy), _ = camera.K
    low, high = _reach(T_world_cam, camera.K, depth.shape[1:], grid, depth.max(axis=(1, 2)) + truncation)
    tile = max(1, -(-camera.width // DEPTH_TILES))
    room = int(np.prod(high - low, axis=1).max(initial=0))
    block, words = np.empty(room, np.int64), np.empty((room, len(rows)), np.uint64)
    seen = []
    for image, T, first, end in zip(depth, T_cam_world, low, high, strict=True):
        n = _observe(
            image, _tiles(image, tile), tile, T, (fx, fy, cx, cy), grid, truncation, config.min_depth, first, end,
            rows, block, words,
        )  # fmt: skip
        seen.append(Observed(block[:n].copy(), words[:n].copy()))
    return seen


def _reach(
    T_world_cam: np.ndarray, K: np.ndarray, size: tuple[int, ...], grid: Grid, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes of blocks, first and past the last ``(views, 3)``, around all that is seen up to ``depth`` (m)."""
    corners = np.array([[u, v, 1.0] for u in (-0.5, size[1] - 0.5) for v in (-0.5, size[0] - 0.5)])
    rays = np.concatenate([corners @ np.linalg.inv(K).T, np.zeros((1, 3))])  # and the camera's own place
    points = depth[:, None, None] * (rays @ T_world_cam[:, :3, :3].swapaxes(1, 2)) + T_world_cam[:, None, :3, 3]
    cells = (points - np.array(grid.origin)) / grid.voxel
    low = np.floor(cells.min(axis=1) - 1.0).astype(np.int64) // BLOCK
    high = np.ceil(cells.max(axis=1) + 1.0).astype(np.int64) // BLOCK + 1
    return np.clip(low, 0, grid.blocks), np.clip(np.maximum(high, low), 0, grid.blocks)


@njit(cache=True, nogil=True)
def _tiles(depth, size):
    """Return the largest depth in tiles of ``size x size`` pixels."""
    height, width = depth.shape
    tiles = np.zeros(((height + size - 1) // size, (width + size - 1) // size), np.float32)
    for v in range(height):
        for u in range(width):
            tiles[v // size, u // size] = max(tiles[v // size, u // size], depth[v, u])
    return tiles


@njit(cache=True, nogil=True)
def _in_view(x, y, z, radius, tiles, size, shape, K, truncation, min_depth):
    """Return False only where a sphere at camera-frame ``x, y, z`` holds no observed cell."""
    fx, fy, cx, cy = K
    height, width = shape
    if z + radius <= min_depth:
        return False
    left, right = cx + 0.5, width - 0.5 - cx
    above, below = cy + 0.5, height - 0.5 - cy
    outside = (
        fx * x + left * z < -radius * np.hypot(fx, left)
        or -fx * x + right * z < -radius * np.hypot(fx, right)
        or fy * y + above * z < -radius * np.hypot(fy, above)
        or -fy * y + below * z < -radius * np.hypot(fy, below)
    )
    if outside:
        return False
    u0, u1, v0, v1 = 0, tiles.shape[1] - 1, 0, tiles.shape[0] - 1
    near = z - radius
    if near > 1e-3:  # else the sphere's image has no bound
        u0 = max(u0, int(min(((x - radius) / near), (x - radius) / (z + radius)) * fx + cx) // size - 1)
        u1 = min(u1, int(max(((x + radius) / near), (x + radius) / (z + radius)) * fx + cx) // size + 1)
        v0 = max(v0, int(min(((y - radius) / near), (y - radius) / (z + radius)) * fy + cy) // size - 1)
        v1 = min(v1, int(max(((y + radius) / near), (y + radius) / (z + radius)) * fy + cy) // size + 1)
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if tiles[v, u] > 0.0 and near <= tiles[v, u] + truncation:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _observe(depth, tiles, size, T, K, grid, truncation, min_depth, low, high, rows, block, words):
    """Fill ``block`` and ``words``; return the number of blocks."""
    fx, fy, cx, cy = K
    (_, by, bz), (ox, oy, oz), voxel = grid
    height, width = depth.shape
    half = 0.5 * (BLOCK - 1) * voxel
    radius = np.sqrt(3.0) * half + 1e-4
    per_row = rows.shape[0]
    n = 0
    for bi in range(low[0], high[0]):
        for bj in range(low[1], high[1]):
            for bk in range(low[2], high[2]):
                wx, wy, wz = ox + bi * BLOCK * voxel, oy + bj * BLOCK * voxel, oz + bk * BLOCK * voxel
                x0 = T[0, 0] * wx + T[0, 1] * wy + T[0, 2] * wz + T[0, 3]
                y0 = T[1, 0] * wx + T[1, 1] * wy + T[1, 2] * wz + T[1, 3]
                z0 = T[2, 0] * wx + T[2, 1] * wy + T[2, 2] * wz + T[2, 3]
                xm = x0 + (T[0, 0] + T[0, 1] + T[0, 2]) * half
                ym = y0 + (T[1, 0] + T[1, 1] + T[1, 2]) * half
                zm = z0 + (T[2, 0] + T[2, 1] + T[2, 2]) * half
                if not _in_view(xm, ym, zm, radius, tiles, size, depth.shape, K, truncation, min_depth):
                    continue
                seen_any = False
                for s in range(per_row):
                    word = np.uint64(0)
                    for r in range(ROWS):
                        i, j, k = (r >> 3) * voxel, (r & 7) * voxel, rows[s, r] * voxel
                        z = z0 + T[2, 0] * i + T[2, 1] * j + T[2, 2] * k
                        if z <= min_depth:
                            continue
                        x = x0 + T[0, 0] * i + T[0, 1] * j + T[0, 2] * k
                        y = y0 + T[1, 0] * i + T[1, 1] * j + T[1, 2] * k
                        u, v = np.rint(x / z * fx + cx), np.rint(y / z * fy + cy)
                        if u < 0.0 or u >= width or v < 0.0 or v >= height:
                            continue
                        d = depth[int(v), int(u)]
                        if d > min_depth and d - z > -truncation:
                            word |= np.uint64(1) << np.uint64(r)
                    words[n, s] = word
                    seen_any = seen_any or word != 0
                if seen_any:
                    block[n] = (bi * by + bj) * bz + bk
                    n += 1
    return n
