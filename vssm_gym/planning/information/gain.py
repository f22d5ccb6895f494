"""``I(M; x_>t | z_>t) = H(M) - E_x H(M | x, z) = sum_cells 1/2 log(1 + n lambda_u / lambda)`` of trajectories (SPEC 8).

``lambda`` is a cell's precision, ``lambda_u`` that of one update and ``n`` the number of a trajectory's images that
observe the cell: precisions add whatever is read, so given which cells the images observe, the posterior's entropy is
known exactly, and what several images of one trajectory share is counted once. Which cells they observe is imagined:
images are rendered at the mean of the current belief, all of a trajectory's from the same one.

Steps at the same pose, of one trajectory or of many, are one view: rendered once, its cells listed once. Trajectories
are counted in an order in which those with a common beginning follow each other, and the beginning is counted once:
a breadth-first tree costs as many steps as it has nodes.

Looking again is never worth nothing: a cell seen ``n`` times gains ``1/(2n)`` by the next look, without bound in the
sum. Against 2.3 nats of the first look (prior std 10 m, update std 1) that is little a cell, but known cells are many.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from vssm_gym.block_table import BLOCK
from vssm_gym.camera import Camera
from vssm_gym.errors import InputError
from vssm_gym.inference.observation import MapUpdateConfig
from vssm_gym.planning.information.imagined import imagine
from vssm_gym.planning.information.observed import ROWS, Grid, Observed, heights, observed
from vssm_gym.voxel_map import VoxelMap


@dataclass(frozen=True)
class InformationConfig:
    """How finely gains are computed: the default is a fast estimate, ``EXACT`` the whole."""

    pixels: int | None = 1200  # of an imagined image, which is a smaller one of the same view; None: the camera's own
    every: int = 8  # one cell in so many stands for its neighbours: 1 (all), 2, 4 or 8
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    max_depth: float = 8.0  # m that an imagined ray goes where it meets nothing; up to update.max_depth

    def __post_init__(self) -> None:
        if self.pixels is not None and self.pixels < 1:
            raise InputError("InformationConfig", "pixels", f"at least 1, or None for all; found {self.pixels!r}")
        if self.every not in (1, 2, 4, 8):
            raise InputError("InformationConfig", "every", f"1, 2, 4 or 8; found {self.every!r}")
        if not self.update.min_depth < self.max_depth <= self.update.max_depth:
            expected = f"above {self.update.min_depth} m, up to the update's {self.update.max_depth} m"
            raise InputError("InformationConfig", "max_depth", f"{expected}; found {self.max_depth!r}")


DEFAULT = InformationConfig()
EXACT = InformationConfig(pixels=None, every=1)


class Gain(NamedTuple):
    """Expected information of trajectories, nats of occupancy."""

    total: np.ndarray  # (candidates,) of the whole trajectory
    along: np.ndarray  # (candidates, steps) of steps 0 to k together


def expected_gain(
    m: VoxelMap,
    T_world_cam: np.ndarray,
    camera: Camera,
    config: InformationConfig = DEFAULT,
    valid: np.ndarray | None = None,
) -> Gain:
    """``I(M; x_1:k | z_1:k)`` of candidate trajectories, for every k (see the module).

    Args:
        m: map belief, dense or block-sparse.
        T_world_cam: ``(candidates, steps, 4, 4)`` camera poses. Equal ones are rendered once.
        camera: the robot's.
        config: pixels and cells used, and the map update.
        valid: ``(candidates, steps)`` bool: steps that exist, where trajectories are of different length.

    Raises:
        InputError: arrays that do not fit.
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
    return gain_of_paths(m, views.reshape(-1, 4, 4), paths, camera, config)


def gain_of_paths(
    m: VoxelMap, views: np.ndarray, paths: np.ndarray, camera: Camera, config: InformationConfig = DEFAULT
) -> Gain:
    """:func:`expected_gain` of trajectories through a given set of views, as a search tree's nodes are.

    Args:
        m: map belief.
        views: ``(views, 4, 4)`` camera poses.
        paths: ``(candidates, steps)`` indices of views; -1 where a trajectory has no step.
        camera: the robot's.
        config: pixels and cells used, and the map update.

    Raises:
        InputError: poses that are not finite, or a path through views that do not exist.
    """
    views, paths = np.asarray(views, np.float64), np.asarray(paths, np.int64)
    if not np.isfinite(views).all():
        raise InputError("information", "T_world_cam", "finite poses")
    if paths.size and not (paths.min() >= -1 and paths.max() < len(views)):
        raise InputError("information", "paths", f"indices of the {len(views)} views, or -1; found {paths.max()}")
    if paths.size == 0 or len(views) == 0:
        return Gain(np.zeros(paths.shape[0]), np.zeros(paths.shape))
    small = _imagined_camera(camera, config.pixels)
    depths, grid = imagine(m, views, small, config.max_depth), Grid.of(m)
    seen = [
        observed(depth, T, small, grid, config.update, config.every) for depth, T in zip(depths, views, strict=True)
    ]
    order = np.lexsort(paths.T[::-1])  # common beginnings beside each other
    along = np.empty(paths.shape)
    _count(paths, order, *_listed(m, seen, config.every), config.update.std**-2, along)
    along *= config.every
    return Gain(along[:, -1].copy(), along)


def _imagined_camera(camera: Camera, pixels: int | None) -> Camera:
    """The same view in at least so many pixels, or as many as the camera has."""
    if pixels is None or pixels >= camera.width * camera.height:
        return camera
    scale = np.sqrt(pixels / (camera.width * camera.height))
    return camera.resized(*(int(np.ceil(n * scale - 1e-9)) for n in (camera.width, camera.height)))


def _listed(m: VoxelMap, seen: list[Observed], every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """All views' cells in one list, with a place and a precision for every cell of the blocks that any of them sees.

    Returns:
        Where each view's entries start ``(views + 1,)``; the entries' place among the blocks seen; their bit sets; and
        the precisions ``(blocks seen, 8 / every, 64)`` of the cells that the bits stand for.
    """
    start = np.cumsum([0, *(len(view.block) for view in seen)])
    blocks, place = np.unique(np.concatenate([view.block for view in seen]), return_inverse=True)
    slot = blocks if m.table is None else np.asarray(m.table.slot).reshape(-1)[blocks]
    cells = np.arange(ROWS) * BLOCK + heights(every)
    precision = np.asarray(m.occupancy_precision)[slot[:, None, None], cells]
    return start, place, np.concatenate([view.words for view in seen]), precision


@njit(cache=True, nogil=True)
def _add(view, start, place, words, precision, weight, counts):
    """Count one more image of a view's cells; returns the nats that it adds."""
    nats, product = 0.0, 1.0
    for entry in range(start[view], start[view + 1]):
        b = place[entry]
        for s in range(words.shape[1]):
            word = words[entry, s]
            for r in range(ROWS):
                if (word >> np.uint64(r)) & np.uint64(1):
                    now = precision[b, s, r] + counts[b, s, r] * weight
                    product *= 1.0 + weight / now
                    counts[b, s, r] += 1
                    if product > 1e100:  # one logarithm for many cells
                        nats += np.log(product)
                        product = 1.0
    return 0.5 * (nats + np.log(product))


@njit(cache=True, nogil=True)
def _remove(view, start, place, words, counts):
    """Take one image of a view's cells back."""
    for entry in range(start[view], start[view + 1]):
        b = place[entry]
        for s in range(words.shape[1]):
            word = words[entry, s]
            for r in range(ROWS):
                counts[b, s, r] -= (word >> np.uint64(r)) & np.uint64(1)


@njit(cache=True, nogil=True)
def _count(paths, order, start, place, words, precision, weight, along):
    """Fill ``along``: trajectories in turn, each taking over the counts of the beginning it shares with the last."""
    counts = np.zeros(precision.shape, np.uint16)
    steps = paths.shape[1]
    last = order[0]
    for turn in range(len(order)):
        c = order[turn]
        shared = 0
        if turn > 0:
            while shared < steps and paths[c, shared] == paths[last, shared]:
                along[c, shared] = along[last, shared]
                shared += 1
            for step in range(shared, steps):
                if paths[last, step] >= 0:
                    _remove(paths[last, step], start, place, words, counts)
        for step in range(shared, steps):
            gained = along[c, step - 1] if step > 0 else 0.0
            if paths[c, step] >= 0:
                gained += _add(paths[c, step], start, place, words, precision, weight, counts)
            along[c, step] = gained
        last = c
