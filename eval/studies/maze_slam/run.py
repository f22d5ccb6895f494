"""Run methods of SLAM on traversals of mazes, one row of a file for each run, and continue where that stopped."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax

from vssm_gym.envs.maze_noise import MOTION_NOISE, RANGE_NOISE
from vssm_gym.envs.tasks.mazes import MAZES
from vssm_gym.envs.validation import StrictModel
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.studies.maze_slam.methods import DRAWS_PARTICLES, METHODS, judged_run
from vssm_gym.eval.studies.row_file import read_rows
from vssm_gym.files.line_file import LineFile
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version

MAZE_SLAM_ROWS = "maze-slam.jsonl"  # in the study's folder
RUNS_CACHED = 16  # maps differ in size, and the programs of a hundred runs exhaust a process's memory maps
_SHARED = ("steps", "noise", "sensor_noise")


@dataclass(frozen=True)
class MazeSlamSetting:
    """Hold what is run: every method on every traversal of every maze.

    Args:
        mazes: their names.
        methods: of :data:`METHODS`.
        traversals: of each maze: seeds of the drive, from 0 on.
        seeds: of the particles, from 0 on, where a method draws some.
        steps: of a traversal.
        noise: level of the execution noise.
        sensor_noise: level of the noise of ranges or pixels.
    """

    mazes: tuple[str, ...] = MAZES[1:]  # all numbers were chosen on the first
    methods: tuple[str, ...] = ("odometry", "occupancy", "latent", "latent_offline")
    traversals: int = 4
    seeds: int = 3
    steps: int = 3000
    noise: str = "low"
    sensor_noise: str = "low"

    def __post_init__(self) -> None:
        known = {"mazes": MAZES, "methods": tuple(METHODS)}
        for name, names in known.items():
            for one in getattr(self, name):
                if one not in names:
                    raise InputError("maze-slam", name, one_of(names, one))
        for name, levels in (("noise", MOTION_NOISE), ("sensor_noise", RANGE_NOISE)):
            if getattr(self, name) not in levels:
                raise InputError("maze-slam", name, one_of(levels, getattr(self, name)))
        for name in ("traversals", "seeds", "steps"):
            if getattr(self, name) < 1:
                raise InputError("maze-slam", name, f"at least 1, not {getattr(self, name)}")


class MazeSlamRow(StrictModel):
    """Hold one run: what ran, errors of the position in m, NEES over the dimension, and s."""

    maze: str
    traversal: int
    method: str
    seed: int
    end: float
    mean: float
    largest: float
    errors: list[float]
    nees: float | None
    in_95: float | None
    seconds: float
    steps: int
    noise: str
    sensor_noise: str
    version: str


def run(setting: MazeSlamSetting, out: Path, on_progress: OnProgress | None = None) -> list[dict[str, Any]]:
    """Return the rows of all runs; those that the file in ``out`` holds are not run again.

    Args:
        setting: what is run.
        out: folder of the file of rows.
        on_progress: called with ("tracking", runs done, runs).

    Raises:
        InputError: a file whose rows are of another setting, or no rows.
    """
    shared = {name: value for name, value in asdict(setting).items() if name in _SHARED}
    done = {key_of(row): row for row in read_rows(out / MAZE_SLAM_ROWS, MazeSlamRow)}
    for row in done.values():
        for name, value in shared.items():
            if row[name] != value:
                raise InputError(out / MAZE_SLAM_ROWS, name, f"{value}, as in this study; found {row[name]!r:.80}")
    runs = list(_runs(setting))
    with LineFile(out / MAZE_SLAM_ROWS) as file:
        for k, key in enumerate(runs):
            if on_progress:
                on_progress("tracking", k, len(runs))
            if key in done:
                continue
            maze, traversal, method, seed = key
            found = judged_run(method, maze, traversal, seed, **shared)
            of = {"maze": maze, "traversal": traversal, "method": method, "seed": seed}
            done[key] = row = of | found | shared | {"version": package_version()}
            file.append((json.dumps(row) + "\n").encode())
            if k % RUNS_CACHED == RUNS_CACHED - 1:
                jax.clear_caches()
    return [done[key] for key in runs]


def key_of(row: dict[str, Any]) -> tuple[str, int, str, int]:
    """Return what identifies a row: maze, traversal, method, seed."""
    return row["maze"], row["traversal"], row["method"], row["seed"]


def _runs(setting: MazeSlamSetting) -> Iterator[tuple[str, int, str, int]]:
    """Yield the keys; mazes vary slowest but for the seeds, so that what is stopped early holds every maze."""
    for seed in range(setting.seeds):
        for traversal in range(setting.traversals):
            for maze in setting.mazes:
                for method in setting.methods:
                    if seed == 0 or method in DRAWS_PARTICLES:
                        yield maze, traversal, method, seed
