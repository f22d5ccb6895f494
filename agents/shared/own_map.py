"""Keep an explorer's belief about its surroundings: its map, the places of its body, and near observations.

The map is a :class:`VoxelMap` that a :class:`~vssm_gym.agents.shared.mapping.Mapper` builds. Masks over its columns are
kept with it. A body, a disc or a car's rectangle, disproves any obstacle that is believed to stand where it is. The
ring around it, over which the camera looks, is free where nothing was seen: around a disc, which turns to where it
drives, wherever it has been; around a car only where it started. A ring that moved with a car would mark unseen
cells behind it as free before it has seen them. A thin leg, which averages away in cells wider than itself, is
remembered as it was seen from nearby. Where the camera looked and measured nothing, something is nearer than it
measures.
"""

from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.agents.shared.mapping import Mapper
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.maps.columns import BODY_HEIGHTS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.floor_plan import FloorPlan

READ = 0.15  # share of a part of an image: with less depth in it, what is there is too near to be measured


@dataclass(frozen=True)
class OwnMapConfig:
    """Configure the extent of the map and the heights of the body; lengths in metres."""

    voxel: float = 0.07
    extent: float = 36.0  # along x and y, the start in its middle: the apartment's size is not known
    levels: tuple[float, float] = (-0.35, 3.2)  # heights that the map covers
    slots: int = 8000  # blocks with storage, 100 MB: five apartments of 100 m^2
    heights: tuple[float, float] = BODY_HEIGHTS  # of the body above the floor
    ring: float = 0.08  # around where the body has been, a car: where it started; free where nothing was seen
    close_range: float = 2.0  # within which measurements at the body's height are remembered one by one
    close_low: float = 0.025  # lowest height of these above the floor
    blind_range: float = 0.42  # within which depth cameras measure nothing: what has no depth is as near

    def empty_map(self, start: np.ndarray) -> VoxelMap:
        """Return the map of a robot that starts at ``start`` ``(x, y, ...)`` and has seen nothing."""
        low, high = self.levels
        n, nz = round(self.extent / self.voxel), round((high - low) / self.voxel)
        corner = np.asarray(start, np.float64)[:2] - 0.5 * self.voxel * (n - 1)
        return VoxelMap.prior(np.array([*corner, low]), self.voxel, (n, n, nz), slots=self.slots)


class OwnMap:
    """Hold the belief of one episode; see the module."""

    def __init__(self, context: AgentContext, mapper: Mapper, config: OwnMapConfig, observation: Observation) -> None:
        """Begin with the first observation, seen from ``context.start_pose``."""
        self.config, self._mapper = config, mapper
        self.camera = Camera.from_matrix(context.K, *context.camera)
        self.T_body_cam = np.asarray(context.T_body_cam, np.float64)
        self.radius = 0.5 * context.body_length
        self._car = context.car
        prior = config.empty_map(context.start_pose)
        shape = prior.shape[:2]
        self._corner = np.asarray(prior.origin, np.float64)[:2]
        self._body, self._near = np.zeros(shape, bool), np.zeros(shape, bool)
        self._seen = np.zeros(shape, np.int16)
        self._met, self._blind = np.zeros(shape, bool), np.zeros(shape, bool)
        self._rays = np.asarray(self.camera.rays(), np.float64)[::2, ::2]
        self.estimate = mapper.reset(prior, context, observation)
        self._surround(self.estimate.planar)
        self._mark(observation)

    @property
    def map(self) -> VoxelMap:
        """Return the belief, world frame; it is valid until the next observation."""
        return self._mapper.map

    @property
    def is_full(self) -> bool:
        """Return True where something was seen that the map had no storage left for."""
        table = self.map.table
        return table is not None and int(table.refused) > 0

    def take(self, command: np.ndarray, observation: Observation) -> None:
        """Update the map with what was seen after ``command`` ``(turn, o, s)``; ``estimate`` is the new pose."""
        self.estimate = self._mapper.update(command, observation)
        if not self.estimate.lost:
            self._mark(observation)

    def _mark(self, observation: Observation) -> None:
        """Update the masks with the body's place and with what is seen close by."""
        planar = self.estimate.planar
        depth = np.asarray(observation["depth"], np.float32)
        self._stand(planar)
        if self._car is None:
            self._surround(planar)
        T_world_cam = planar_to_matrix(planar) @ self.T_body_cam
        self._notice(depth[::2, ::2], T_world_cam)
        self._miss(depth[::2, ::2], T_world_cam)

    def plan(self, keep: np.ndarray | None = None) -> FloorPlan:
        """Read the floor plan of the present belief, with places to ``keep`` ``(n, 2)``, m, in it."""
        low, high = self.config.heights
        seen = (self._seen >= 2) | self._met
        return FloorPlan.of(self.map, low, high, self._body, self._near, seen, self._blind, keep)

    def meet(self, xy: np.ndarray, radius: float) -> None:
        """Remember an obstacle that was met and not seen: a disc at ``xy`` ``(2,)``, m."""
        window, away = self._around(xy, radius)
        self._met[window] |= away <= radius
        self._body[window] &= away > radius

    def doubt(self, xy: np.ndarray, radius: float) -> bool:
        """Forget what was seen from nearby or met within ``radius`` of ``xy`` (m): it has to be seen again.

        Return False where there was nothing to forget.
        """
        window, away = self._around(xy, radius)
        doubted = (away <= radius) & ((self._seen[window] >= 2) | self._met[window] | self._blind[window])
        self._seen[window] = np.where(away <= radius, 0, self._seen[window])
        self._met[window] &= away > radius
        self._blind[window] &= away > radius
        return bool(doubted.any())

    def bump(self, planar: np.ndarray, ahead: bool) -> None:
        """Remember an obstacle at a car's front, or at its back, where something has held it."""
        assert self._car is not None
        offset = self._car.center_forward + np.copysign(
            0.5 * (self._car.length + self.config.voxel), 1 if ahead else -1
        )
        sides = np.linspace(-0.5, 0.5, 9) * self._car.width
        c, s = np.cos(planar[2]), np.sin(planar[2])
        xy = planar[:2] + np.stack([c * offset - s * sides, s * offset + c * sides], axis=-1)
        cell = np.floor((xy - self._corner) / self.config.voxel + 0.5).astype(int)
        cell = cell[np.all((cell >= 0) & (cell < self._seen.shape), axis=1)]
        self._seen[cell[:, 0], cell[:, 1]] = 2

    def _stand(self, planar: np.ndarray) -> None:
        """Mark the columns of the body at ``planar`` (m, rad)."""
        window, away = self._away(planar, 0.0)
        self._body[window] |= away <= 0.0

    def _surround(self, planar: np.ndarray) -> None:
        """Mark the columns of the ring around the body at ``planar`` (m, rad)."""
        window, away = self._away(planar, self.config.ring)
        self._near[window] |= away <= self.config.ring

    def _away(self, planar: np.ndarray, margin: float) -> tuple[tuple[slice, ...], np.ndarray]:
        """Return the columns around the body at ``planar`` (m, rad), grown by ``margin``, and their distances to it."""
        reach = margin + (self.radius if self._car is None else self._car.length)
        window, (x, y) = self._window(planar[:2], reach)
        return window, self._from_body(x, y, float(planar[2]))

    def _from_body(self, x: np.ndarray, y: np.ndarray, heading: float) -> np.ndarray:
        """Return the distances (m) of places relative to the body's origin from its footprint; not positive inside."""
        if self._car is None:
            return np.hypot(x, y) - self.radius
        c, s = np.cos(heading), np.sin(heading)
        along = np.abs(c * x + s * y - self._car.center_forward) - 0.5 * self._car.length
        across = np.abs(c * y - s * x) - 0.5 * self._car.width
        return np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0)) + np.minimum(np.maximum(along, across), 0.0)

    def _around(self, xy: np.ndarray, reach: float) -> tuple[tuple[slice, ...], np.ndarray]:
        """Return the columns of the box within ``reach`` of ``xy`` (m), and their distances to it."""
        window, (x, y) = self._window(xy, reach)
        return window, np.hypot(x, y)

    def _window(self, xy: np.ndarray, reach: float) -> tuple[tuple[slice, ...], tuple[np.ndarray, np.ndarray]]:
        """Return the columns of the box within ``reach`` of ``xy`` (m), and their places relative to it."""
        first = np.floor((xy - reach - self._corner) / self.config.voxel).astype(int)
        size = int(2.0 * reach / self.config.voxel) + 2
        window = tuple(slice(max(0, f), min(max(0, f + size), n)) for f, n in zip(first, self._body.shape, strict=True))
        x, y = (self._corner[a] + self.config.voxel * np.arange(w.start, w.stop) - xy[a] for a, w in enumerate(window))
        return window, (x[:, None], y[None, :])

    def _notice(self, depth: np.ndarray, T_world_cam: np.ndarray) -> None:
        """Count measurements at the body's height nearby; a camera's errors grow with the square of the depth."""
        c = self.config
        p_world = (self._rays * depth[..., None]) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
        floor = c.close_low + 0.01 * depth**2
        held = (depth > 0.05) & (depth < c.close_range) & (p_world[..., 2] > floor) & (p_world[..., 2] < c.heights[1])
        cell = np.floor((p_world[held][:, :2] - self._corner) / c.voxel + 0.5).astype(int)
        cell = cell[np.all((cell >= 0) & (cell < self._seen.shape), axis=1)]
        number, count = np.unique(cell[:, 0] * self._seen.shape[1] + cell[:, 1], return_counts=True)
        flat = self._seen.reshape(-1)
        flat[number] = np.minimum(flat[number] + np.minimum(count, 2), 100)

    def _miss(self, depth: np.ndarray, T_world_cam: np.ndarray) -> None:
        """Mark what is nearer than the camera measures: columns of the image with next to no depth below its top.

        Farther away the floor has depth, if nothing else has.
        """
        top = depth.shape[0] // 3
        without = np.mean((depth[top:] > 0.0) & np.isfinite(depth[top:]), axis=0) < READ
        away = np.arange(0.5 * self.config.voxel, self.config.blind_range, 0.5 * self.config.voxel)
        rays = self._rays[depth.shape[0] // 2, without] @ T_world_cam[:3, :3].T
        xy = T_world_cam[:2, 3] + away[:, None, None] * rays[:, :2] / np.hypot(rays[:, 0], rays[:, 1])[:, None]
        cell = np.floor((xy.reshape(-1, 2) - self._corner) / self.config.voxel + 0.5).astype(int)
        cell = cell[np.all((cell >= 0) & (cell < self._blind.shape), axis=1)]
        self._blind[cell[:, 0], cell[:, 1]] = True
