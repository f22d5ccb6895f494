"""Define a box room in closed form, float64: the oracle of tests of maps, rendering and localisation."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import R_BODY_CAM
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest and highest, m


def box_distance(p: np.ndarray, corners: Corners) -> np.ndarray:
    """Return exact signed distance (m, negative inside) of points (..., 3) to an upright box."""
    low, high = np.array(corners)
    q = np.abs(p - 0.5 * (low + high)) - 0.5 * (high - low)
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)


def slab(centre: np.ndarray, directions: np.ndarray, corners: Corners) -> tuple[np.ndarray, np.ndarray]:
    """Return ray parameters (rays,) where rays enter and leave a box; entry > exit where they miss it."""
    with np.errstate(divide="ignore"):
        a, b = ((np.array(c) - centre) / directions for c in corners)
    return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)


def camera_pose(position: tuple[float, float, float], yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Return T_world_cam, float64, of a camera that looks along world x, rolled, pitched down and turned left (rad)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    turn = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    dip = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    tilt = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn @ dip @ tilt @ np.array(R_BODY_CAM), position
    return T


def ray_directions(T_world_cam: np.ndarray, camera: Camera) -> np.ndarray:
    """Return world directions (height * width, 3) per metre of z-depth, from the inverse of K; float64."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3).astype(float)
    return pixels @ np.linalg.inv(camera.K).T @ T_world_cam[:3, :3].T


@dataclass(frozen=True)
class Room:
    """Describe free space inside ``interior`` without the solid ``boxes``, with smooth textures."""

    interior: Corners
    boxes: tuple[Corners, ...] = ()

    def occupancy(self, p: np.ndarray) -> np.ndarray:
        """Return negative signed distance (m), positive in walls and boxes."""
        solids = [box_distance(p, self.interior), *(-box_distance(p, box) for box in self.boxes)]
        return np.max(solids, axis=0)

    def colour(self, p: np.ndarray) -> np.ndarray:
        """Return RGB (..., 3) in [0.1, 0.9]."""
        x, y, z = np.moveaxis(np.asarray(p), -1, 0)
        waves = [
            np.sin(9 * x + 4 * z) * np.cos(7 * y - 2 * z),
            np.sin(6 * y + 8 * z + 1) * np.cos(5 * x),
            np.sin(10 * z - 6 * x + 2) * np.cos(8 * y),
        ]
        return 0.5 + 0.4 * np.stack(waves, axis=-1)

    def depth(self, T_world_cam: np.ndarray, camera: Camera) -> np.ndarray:
        """Return z-depth (height, width), m."""
        centre, directions = T_world_cam[:3, 3], ray_directions(T_world_cam, camera)
        depth = slab(centre, directions, self.interior)[1]
        for box in self.boxes:
            enter, leave = slab(centre, directions, box)
            depth = np.where((enter < leave) & (enter > 0.0), np.minimum(depth, enter), depth)
        return depth.reshape(camera.height, camera.width)

    def image(self, T_world_cam: np.ndarray, camera: Camera) -> RGBD:
        """Take the image of an ideal camera."""
        depth = self.depth(T_world_cam, camera)
        p = T_world_cam[:3, 3] + ray_directions(T_world_cam, camera) * depth.reshape(-1, 1)
        seen = jnp.ones(depth.shape, bool)
        rgb = self.colour(p).reshape(*depth.shape, 3)
        return RGBD(jnp.asarray(depth, jnp.float32), jnp.asarray(rgb, jnp.float32), seen, seen)

    def to_map(self, origin: tuple[float, float, float], voxel_size: float, shape: tuple[int, int, int]) -> VoxelMap:
        """Return a map whose cells hold the exact signed distance and colour, all of them observed."""
        m = VoxelMap.prior(origin, voxel_size, shape)
        p = cell_centres(m)
        observed = jnp.full_like(m.occupancy_precision, 10.0)
        return VoxelMap(
            occupancy=m.blocked(jnp.asarray(self.occupancy(p), jnp.float32)),
            occupancy_precision=observed,
            colour=m.blocked(jnp.asarray(self.colour(p), jnp.float32)),
            colour_precision=observed,
            empty=m.empty,
            origin=m.origin,
            voxel_size=m.voxel_size,
            blocks=m.blocks,
        ).with_occupancy(m.blocked(jnp.asarray(self.occupancy(p), jnp.float32)))


def cell_centres(m: VoxelMap) -> np.ndarray:
    """Return world positions (nx, ny, nz, 3) of the cells, float64."""
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in m.shape), indexing="ij"), axis=-1)
    return np.asarray(m.origin, float) + cells * float(m.voxel_size)
