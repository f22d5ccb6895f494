"""Compute ``I(M; x_>t | z_>t) = H(M) - E_x H(M | x, z) = sum_cells 1/2 log(1 + n lambda_u / lambda)`` (eq. P33).

``lambda`` is a cell's precision, ``lambda_u`` that of one update and ``n`` the number of a trajectory's images that
observe the cell. Precisions add, independent of the measured values. Given which cells the images observe, the
posterior's entropy is therefore known exactly, and what several images of one trajectory share is counted once. Which
cells they observe is imagined: images are rendered from the current belief, all of a trajectory's from the same one. At
the belief's mean the unknown is free; :mod:`~vssm_gym.planning.exploration.information.ray_termination` limits how far
rays go into it.

Steps at the same pose, of one trajectory or of many, are one view: rendered once, its cells listed once.

Another view always gains something (eq. P34): a cell seen ``n`` times gains ``1/(2n)`` by the next view, without bound
in the sum. Against 2.3 nats of the first view (prior std 10 m, update std 1) that is little per cell, but known cells
are many. ``known`` leaves them out; the result is then no longer mutual information but what is new.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.information.imagined import draw, imagine
from vssm_gym.planning.exploration.information.information_sum import gains
from vssm_gym.planning.exploration.information.observed import Grid, observed
from vssm_gym.planning.exploration.information.pose import pose_gain
from vssm_gym.planning.exploration.information.ray_termination import end_rays


@dataclass(frozen=True)
class InformationConfig:
    """Configure how finely gains are computed; the default is a fast estimate, ``pixels=None, every=1`` takes all."""

    pixels: int | None = 1200  # of an imagined image, which is a smaller one of the same view; None: the camera's own
    every: int = 8  # one cell in so many stands for its neighbours: 1 (all), 2, 4 or 8
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    max_depth: float = 8.0  # m that an imagined ray goes where it meets nothing; up to update.max_depth
    known: float = np.inf  # 1/m^2; cells of more precision than this gain nothing: see the module
    ground: float = -np.inf  # world z of the plane that the robot stands on, m, where imagined rays end
    samples: int = 0  # of the map, in each of which all images are imagined; 0: the mean
    mean_free_path: float = 1.5  # m that a ray goes through unknown space of a sample, on average
    measurement_std: float = 0.1  # m, of a depth, for the pose: large, because errors of neighbours are correlated
    seed: int = 0  # of the samples: the same in every call, so that candidates are compared in the same maps

    def __post_init__(self) -> None:
        if self.pixels is not None and self.pixels < 1:
            raise InputError("InformationConfig", "pixels", f"at least 1, or None for all; found {self.pixels!r}")
        if self.every not in (1, 2, 4, 8):
            raise InputError("InformationConfig", "every", f"1, 2, 4 or 8; found {self.every!r}")
        if not self.update.min_depth < self.max_depth <= self.update.max_depth:
            expected = f"above {self.update.min_depth} m, up to the update's {self.update.max_depth} m"
            raise InputError("InformationConfig", "max_depth", f"{expected}; found {self.max_depth!r}")
        if self.samples < 0:
            raise InputError("InformationConfig", "samples", f"at least 0; found {self.samples!r}")
        if np.isnan(self.ground):
            raise InputError("InformationConfig", "ground", "metres, or minus infinity for none; found nan")
        if not self.mean_free_path > 0.0:
            raise InputError("InformationConfig", "mean_free_path", f"above 0 m; found {self.mean_free_path!r}")


DEFAULT = InformationConfig()
KNOWN_POSE = np.zeros(3)  # std of x, y (m) and heading (rad)


class Gain(NamedTuple):
    """Hold the expected information of trajectories about the map, and of views about the pose; nats."""

    total: np.ndarray  # (candidates,) of the whole trajectory
    along: np.ndarray  # (candidates, steps) of steps 0 to k together
    pose: np.ndarray  # (views,) of each view alone about the robot's own pose: see `pose`


def expected_gain(
    m: VoxelMap,
    T_world_cam: np.ndarray,
    camera: Camera,
    config: InformationConfig = DEFAULT,
    valid: np.ndarray | None = None,
    hazard: float | np.ndarray = 0.0,
) -> Gain:
    """Compute ``I(M; x_1:k | z_1:k)`` of candidate trajectories, for every k (see the module).

    Args:
        m: map belief, dense or block-sparse.
        T_world_cam: ``(candidates, steps, 4, 4)`` camera poses. Equal ones are rendered once.
        camera: the robot's.
        config: pixels and cells used, and the map update.
        valid: ``(candidates, steps)`` bool: steps that exist, where trajectories are of different length.
        hazard: surfaces expected in a metre of unknown space, 1/m, of all or ``(nx, ny)`` of each column of the map:
            how far imagined rays go there, see :mod:`~vssm_gym.planning.exploration.information.ray_termination`.

    Raises:
        InputError: arrays that do not fit, or poses that are not finite.
    """
    T_world_cam = np.asarray(T_world_cam, np.float32)
    if T_world_cam.ndim != 4 or T_world_cam.shape[2:] != (4, 4):
        raise InputError("information", "T_world_cam", f"(candidates, steps, 4, 4); found {T_world_cam.shape}")
    shape = T_world_cam.shape[:2]
    valid = np.ones(shape, bool) if valid is None else np.asarray(valid, bool)
    if valid.shape != shape:
        raise InputError("information", "valid", f"{shape}, as of the poses; found {valid.shape}")
    views, which = np.unique(T_world_cam[valid].reshape(-1, 16), axis=0, return_inverse=True)
    paths = np.full(shape, -1)
    paths[valid] = which.reshape(-1)
    return gain_of_paths(m, views.reshape(-1, 4, 4), paths, camera, config, hazard=hazard)


def gain_of_paths(
    m: VoxelMap,
    views: np.ndarray,
    paths: np.ndarray,
    camera: Camera,
    config: InformationConfig = DEFAULT,
    std: np.ndarray = KNOWN_POSE,
    hazard: float | np.ndarray = 0.0,
) -> Gain:
    """Compute :func:`expected_gain` of trajectories through a given set of views, as of a search tree's nodes.

    Args:
        m: map belief.
        views: ``(views, 4, 4)`` camera poses.
        paths: ``(candidates, steps)`` indices of views; -1 where a trajectory has no step.
        camera: the robot's.
        config: pixels and cells used, and the map update.
        std: ``(3,)`` of x, y (m) and heading (rad) of each pose before its view.
        hazard: as of :func:`expected_gain`.

    Raises:
        InputError: poses that are not finite, a path through views that do not exist, or samples of a sparse map.
    """
    views, paths = np.asarray(views, np.float64), np.ascontiguousarray(paths, np.int64)
    if views.ndim != 3 or views.shape[1:] != (4, 4) or not np.isfinite(views).all():
        raise InputError("information", "T_world_cam", "finite 4x4 poses")
    if paths.ndim != 2 or (paths.size and not (paths.min() >= -1 and paths.max() < len(views))):
        raise InputError("information", "paths", f"(candidates, steps), each -1 or one of {len(views)} views")
    hazard = np.asarray(hazard, np.float32)
    if hazard.shape not in ((), m.shape[:2]) or not (np.isfinite(hazard) & (hazard >= 0.0)).all():
        found = f"shape {hazard.shape}" if hazard.ndim else f"{hazard}"
        raise InputError("information", "hazard", f"at least 0 1/m, one number or {m.shape[:2]}; found {found}")
    if paths.size == 0 or len(views) == 0:
        return Gain(np.zeros(paths.shape[0]), np.zeros(paths.shape), np.zeros(len(views)))
    small, grid = imagined_camera(camera, config.pixels), Grid.of(m)
    maps = [m]
    if config.samples:
        maps = [draw(config.seed + s, m, config.mean_free_path, config.update.std) for s in range(config.samples)]
    along, pose = np.zeros(paths.shape), np.zeros(len(views))
    for drawn in maps:
        imagined = imagine(drawn, views, small, config.max_depth)
        depths = end_rays(imagined, views, small, m, hazard, config.ground)
        surface = (depths == imagined) & (depths < config.max_depth)
        pose += pose_gain(depths, surface, views, small, std, config.measurement_std) / len(maps)
        seen = observed(depths, views, small, grid, config.update, config.every)
        along += gains(m, seen, paths, config.update.std**-2, config.every, config.known) / len(maps)
    return Gain(along[:, -1].copy(), along, pose)


def imagined_camera(camera: Camera, pixels: int | None) -> Camera:
    """Return a camera of the same view with at least so many pixels, but no more than the camera has."""
    if pixels is None or pixels >= camera.width * camera.height:
        return camera
    scale = np.sqrt(pixels / (camera.width * camera.height))
    return camera.resized(*(int(np.ceil(n * scale - 1e-9)) for n in (camera.width, camera.height)))
