"""Learn the model of a maze's scans that agents are given, from a scripted traversal; keep it in a sweep's folder.

The traversal begins at a known pose, and its map is seen from there: that one pose puts it into the maze's frame. The
others are PRISM's estimates (eq. I73) from scans and odometry.
"""

import json
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vssm_gym.data.traversals import traverse
from vssm_gym.envs.tasks.mazes import Maze, load_maze
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import open_file
from vssm_gym.files.npz_file import open_npz
from vssm_gym.files.output_folders import ADVICE
from vssm_gym.geometry.planar_poses import compose
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.inference.latent.scan_charts import ScanCharts
from vssm_gym.inference.scan_encoder.encoder_file import load_encoder, save_encoder
from vssm_gym.inference.scan_encoder.network import ScanEncoder
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces
from vssm_gym.inference.scan_encoder.training import fit_encoder
from vssm_gym.maps.latent_file import load_latent_grid, save_latent_grid
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.placed_scans import PlacedScans
from vssm_gym.model.scan_emission import OccupancyScans
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner
from vssm_gym.progress import OnProgress
from vssm_gym.slam.latent_run import run_latent
from vssm_gym.slam.planar_run import run_scans
from vssm_gym.version import package_version

TRAVERSAL_STEPS = 3000  # commands: they visit 95 % of the tiles or more
MAZE_CELL = 0.01  # m, of the map
LATENT_MAZE_CELL = 0.05  # m, of the latent grid
MAZE_NOISE = "low"  # of the traversal's motion and ranges
# m, and share of the beams that count: the errors of a map are common to all of them. On pillars-v1 the squared errors
# of filtered poses are then 0.9 times the variance stated.
READING_SCALE, READING_SHARE = 0.01, 0.02
VISITED_STD = 0.02  # m, of the prior about each place of the traversal: half as far as tiles are wide
MAZE_MAP_BYTES = 400_000_000  # of all arrays unpacked
_ARRAYS = ("occupancy", "precision", "origin", "cell_size", "frame", "poses", "angles", "max_range")


def ensure_map(scene: str, folder: Path, *, seed: int, on_progress: OnProgress | None = None, **_: Any) -> Path:
    """Return the file of a maze's learned model, ``folder/maps/NAME.npz``; drive and make it if needed.

    Args:
        scene: a maze's name or file.
        folder: of a sweep.
        seed: of the traversal.
        on_progress: called after every part of the map.

    Raises:
        InputError: a file of another origin at its place.
    """
    maze = load_maze(scene)
    path = folder / "maps" / f"{maze.name}.npz"
    origin = {"scene_hash": maze.apartment.content_hash(), "seed": seed, "steps": TRAVERSAL_STEPS, "noise": MAZE_NOISE}
    if path.exists():
        found = _read(path)[1]
        for name, value in origin.items():
            if found.get(name) != value:
                raise InputError(path, name, f"a map with {value}; found {found.get(name)} ({ADVICE})")
        return path
    log = traverse(maze, TRAVERSAL_STEPS, seed, MAZE_NOISE, MAZE_NOISE)
    run = run_scans(log, MAZE_CELL, on_progress=on_progress)
    assert log.poses is not None
    frame = log.poses[0]  # where the drive is known to begin; no other true pose is read
    arrays = {
        **{name: np.asarray(getattr(run.m, name), np.float32) for name in _ARRAYS[:4]},
        "frame": frame.astype(np.float32),
        "poses": compose(frame, run.poses).astype(np.float32),
        "angles": log.angles.astype(np.float32),
        "max_range": np.float32(log.max_range),
    }
    header = np.frombuffer(json.dumps(origin | {"package_version": package_version()}).encode(), np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, header=header, **arrays)
    return path


class LearnedMaze:
    """Hold what agents are given of a maze, in its frame.

    Attributes:
        model: of scans.
        poses: x, y, heading of the traversal, as its filter has estimated them.
    """

    def __init__(self, path: Path) -> None:
        arrays, origin = _read(path)
        m = PlanarMap(*(jnp.asarray(arrays[name]) for name in _ARRAYS[:4]))
        scanner = Scanner(jnp.asarray(arrays["angles"]), jnp.zeros(3), jnp.asarray(arrays["max_range"]))
        scans = OccupancyScans(m, scanner, READING_SCALE, READING_SHARE)
        self._frame, self._seed = jnp.asarray(arrays["frame"]), int(origin["seed"])
        self.model: ScanModel = PlacedScans(scans, self._frame)
        self.poses, self._path = arrays["poses"], path
        self._latent: ScanModel | None = None

    def latent(self, maze: Maze) -> ScanModel:
        """Return the model of a latent grid, learned from the same drive at first use and kept beside the map.

        Args:
            maze: of the map; its drive is made again from the seed.
        """
        if self._latent is None:
            kept = self._path.with_name(f"{self._path.stem}-latent.npz")
            scanner = self.model.scanner
            if not kept.exists():
                log = traverse(maze, TRAVERSAL_STEPS, self._seed, MAZE_NOISE, MAZE_NOISE)
                save_latent_grid(kept, run_latent(log, LATENT_MAZE_CELL, passes=1).model.m)
            charts = ScanCharts(scanner, LatentConfig())
            self._latent = PlacedScans(charts.model(load_latent_grid(kept)), self._frame)
        return self._latent

    @cached_property
    def encoder(self) -> ScanEncoder:
        """Return ``q(z | x)``, trained at first use (minutes) and kept beside the map."""
        prior = VisitedPlaces.of(self.poses, VISITED_STD)
        kept = self._path.with_name(f"{self._path.stem}-encoder.npz")
        if not kept.exists():
            save_encoder(kept, fit_encoder(self.model, prior)[0])
        return load_encoder(kept, prior, float(self.model.scanner.max_range))


def load_map(path: Path) -> LearnedMaze:
    """Return what a file holds.

    Raises:
        InputError: a missing or damaged file.
    """
    return LearnedMaze(path)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    expected = "a whole file of a maze's learned model"
    with open_file(path) as file, open_npz(file, path, MAZE_MAP_BYTES, expected) as stored:
        arrays = {name: stored.read(name) for name in _ARRAYS}
        header = stored.read_json("header", path)
    shapes = {"precision": arrays["occupancy"].shape, "origin": (2,), "cell_size": (), "frame": (3,), "max_range": ()}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise InputError(path, name, f"an array of shape {shape}; found {arrays[name].shape}")
    for name, array in arrays.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise InputError(path, name, f"finite float32; found {array.dtype}")
    if arrays["poses"].ndim != 2 or arrays["poses"].shape[1] != 3:
        raise InputError(path, "poses", f"rows of 3; found {arrays['poses'].shape}")
    if arrays["occupancy"].ndim != 2 or arrays["angles"].ndim != 1 or not isinstance(header, dict):
        raise InputError(path, "file", expected)
    if not isinstance(header.get("seed"), int):
        raise InputError(path, "seed", f"a whole number; found {header.get('seed')!r}")
    return arrays, header
