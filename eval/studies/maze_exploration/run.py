"""Run explorers in mazes under several seeds, one row of a file for each run, and continue where that stopped."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vssm_gym.envs.maze_noise import MOTION_NOISE, RANGE_NOISE
from vssm_gym.envs.tasks.mazes import MAZES
from vssm_gym.envs.validation import StrictModel
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.studies.maze_exploration.episodes import EXPLORERS, explore
from vssm_gym.eval.studies.row_file import read_rows
from vssm_gym.files.line_file import LineFile
from vssm_gym.progress import OnProgress

EXPLORATION_ROWS = "maze-exploration.jsonl"  # in the study's folder


@dataclass(frozen=True)
class ExplorationSetting:
    """Hold what is run: every explorer in every maze under every seed.

    Args:
        mazes: their names.
        explorers: of :data:`EXPLORERS`.
        seeds: numbers 0 to this one less one.
        steps: of a run.
        noise: level of the execution noise.
        sensor_noise: level of the ranges' noise.
    """

    mazes: tuple[str, ...] = MAZES
    explorers: tuple[str, ...] = tuple(EXPLORERS)
    seeds: int = 7
    steps: int = 1000
    noise: str = "low"
    sensor_noise: str = "low"

    def __post_init__(self) -> None:
        known = {"mazes": MAZES, "explorers": tuple(EXPLORERS)}
        for name, names in known.items():
            for one in getattr(self, name):
                if one not in names:
                    raise InputError("maze-exploration", name, one_of(names, one))
        for name, levels in (("noise", MOTION_NOISE), ("sensor_noise", RANGE_NOISE)):
            if getattr(self, name) not in levels:
                raise InputError("maze-exploration", name, one_of(levels, getattr(self, name)))
        for name in ("seeds", "steps"):
            if getattr(self, name) < 1:
                raise InputError("maze-exploration", name, f"at least 1, not {getattr(self, name)}")


class ExplorationRow(StrictModel):
    """Hold one run: what ran, curves every few steps, and figures of the whole; m and s."""

    maze: str
    seed: int
    agent: str
    task: int
    coverage: list[float]
    nats: list[float]
    collisions: int
    path_length: float
    location_error_mean: float | None
    location_error_max: float | None
    decisions: int
    decision_p50: float | None
    decision_p95: float | None
    steps: int
    noise: str
    sensor_noise: str


def run(setting: ExplorationSetting, out: Path, on_progress: OnProgress | None = None) -> list[dict[str, Any]]:
    """Return the rows of all runs; those that the file in ``out`` holds are not run again.

    Args:
        setting: what is run.
        out: folder of the file of rows.
        on_progress: called with ("exploring", runs done, runs).

    Raises:
        InputError: a file whose rows are of another setting, or no rows.
    """
    shared = {name: value for name, value in asdict(setting).items() if name in ("steps", "noise", "sensor_noise")}
    done = {key_of(row): row for row in read_exploration(out / EXPLORATION_ROWS)}
    for row in done.values():
        for name, value in shared.items():
            if row[name] != value:
                raise InputError(out / EXPLORATION_ROWS, name, f"{value}, as in this study; found {row[name]!r:.80}")
    runs = list(_runs(setting))
    with LineFile(out / EXPLORATION_ROWS) as file:
        for k, (maze, seed, agent) in enumerate(runs):
            if on_progress:
                on_progress("exploring", k, len(runs))
            if (maze, seed, agent) not in done:
                found = explore(EXPLORERS[agent](maze), maze, seed, **shared)
                done[maze, seed, agent] = row = found | {"agent": agent} | shared
                file.append((json.dumps(row) + "\n").encode())
    return [done[key] for key in runs]


def key_of(row: dict[str, Any]) -> tuple[str, int, str]:
    """Return what identifies a row: maze, seed, agent."""
    return row["maze"], row["seed"], row["agent"]


def read_exploration(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file; none where there is no file; an unfinished last line is left out."""
    return read_rows(path, ExplorationRow)


def _runs(setting: ExplorationSetting) -> Iterator[tuple[str, int, str]]:
    """Yield (maze, seed, agent); agents vary fastest, so that what is stopped early is paired."""
    names: Sequence[str] = setting.explorers
    for seed in range(setting.seeds):
        for maze in setting.mazes:
            for agent in names:
                yield maze, seed, agent
