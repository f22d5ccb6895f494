"""End imagined rays at the ground, and after some length of unknown space (eq. P37).

    z_end = min(z_image, z_ground, z where the integral of h along the ray through unknown cells reaches 1)

At the mean all unknown space is free: nothing stops a ray that leaves through a gap between two walls, or that meets
the floor where it has not been seen yet. The expected information of such rays does not exist. Two facts limit
them. A robot on wheels knows the plane that it stands on. Surfaces that are met at random, ``h`` per metre, let a ray
through ``(1 - exp(-h L)) / h`` of ``L`` metres, which is at most ``1 / h``.
"""

import numpy as np
from numba import njit

from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.planning.exploration.information.observed import Grid


def end_rays(
    depth: np.ndarray,
    T_world_cam: np.ndarray,
    camera: Camera,
    m: VoxelMap,
    hazard: float | np.ndarray,
    ground: float,
) -> np.ndarray:
    """Return depth images with rays ended as the module describes.

    Args:
        depth: ``(views, height, width)`` imagined z-depth, m, float32.
        T_world_cam: ``(views, 4, 4)`` camera poses.
        camera: of the images.
        m: map belief; beyond it nothing is known.
        hazard: ``h``, surfaces expected in a metre of unknown space, 1/m: the same everywhere, or ``(nx, ny)`` of the
            map's columns; 0: none.
        ground: world z of the plane that rays end at, m; minus infinity: none.

    Returns:
        ``(views, height, width)`` z-depth, m, float32, nowhere more than ``depth``.
    """
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    T_world_cam = np.asarray(T_world_cam, np.float64)
    centre, directions = T_world_cam[:, :3, 3], np.einsum("vij,hwj->vhwi", T_world_cam[:, :3, :3], rays)
    down, above = directions[..., 2], (centre[:, 2] - ground)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(down < 0.0, np.minimum(depth, np.maximum(above / -down, 0.0)), depth)
    hazard = np.asarray(hazard, np.float32)
    if hazard.any():
        slot = np.arange(np.prod(m.blocks)) if m.table is None else np.asarray(m.table.slot).reshape(-1)
        precision = np.asarray(m.occupancy_precision)
        columns = np.ascontiguousarray(np.broadcast_to(hazard, m.shape[:2]))
        depth = _end(depth, centre, directions, slot, precision, Grid.of(m), m.shape, columns, OBSERVED_PRECISION)
    return depth.astype(np.float32)


@njit(cache=True, nogil=True)
def _end(depth, centre, directions, slot, precision, grid, shape, hazard, known):
    """Step along each ray by one voxel's edge, until one surface is expected in the unknown cells that it crossed."""
    (_, by, bz), (ox, oy, oz), voxel = grid
    nx, ny, nz = shape
    views, height, width = depth.shape
    ended = np.empty_like(depth)
    for view in range(views):
        x0, y0, z0 = centre[view, 0] - ox, centre[view, 1] - oy, centre[view, 2] - oz
        for v in range(height):
            for u in range(width):
                dx, dy, dz = directions[view, v, u]
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                step = voxel / length  # of z-depth
                last, left = depth[view, v, u], 1.0
                for k in range(int(last / step) + 1):
                    z = (k + 0.5) * step
                    i, j = int(np.rint((x0 + z * dx) / voxel)), int(np.rint((y0 + z * dy) / voxel))
                    h = int(np.rint((z0 + z * dz) / voxel))
                    if 0 <= i < nx and 0 <= j < ny and 0 <= h < nz:
                        block = ((i // BLOCK) * by + j // BLOCK) * bz + h // BLOCK
                        cell = (i % BLOCK * BLOCK + j % BLOCK) * BLOCK + h % BLOCK
                        if precision[slot[block], cell] > known:
                            continue
                    met = hazard[min(max(i, 0), nx - 1), min(max(j, 0), ny - 1)]
                    left -= voxel * met
                    if left < 0.0:
                        last = min(last, (z + 0.5 * step) + left / (met * length))
                        break
                ended[view, v, u] = last
    return ended
