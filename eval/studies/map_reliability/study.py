"""Measure the rows of the reliability table one after the other; every finished row gives a complete study."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.studies.calibration.split import DIVISIONS, seed_of
from vssm_gym.eval.studies.map_reliability.surface_errors import measure
from vssm_gym.eval.studies.map_reliability.table import StoredRow, study_of, summarise
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.eval.studies.stored_rows import stored_rows
from vssm_gym.progress import OnProgress

SOURCE = "study map-reliability"
SMALLEST_CELL, LARGEST_CELL = 0.02, 0.2  # m


@dataclass(frozen=True)
class Row:
    """Describe a row: poses at which images enter the maps, and the noise of the camera."""

    poses: Literal["recorded", "estimated"]
    sensor_noise: str


ROWS = {
    "true poses, exact depth": Row("recorded", "none"),
    "true poses, Kinect": Row("recorded", "kinect"),
    "estimated poses, exact depth": Row("estimated", "none"),
    "estimated poses, Kinect": Row("estimated", "kinect"),
}


@dataclass(frozen=True)
class Setting:
    """Hold what decides the numbers of a row; a study that is continued keeps it."""

    split: Split = "train"
    seed: int = 0
    maps: int | None = None  # of every row; None: one of each apartment of the split
    voxel: float = 0.05  # m

    def __post_init__(self) -> None:
        if self.split not in DIVISIONS:
            raise InputError(SOURCE, "split", one_of(DIVISIONS, self.split))
        if self.maps is not None and self.maps < 1:
            raise InputError(SOURCE, "maps", f"at least 1; found {self.maps}")
        if not 0 <= self.seed < 2**31:
            raise InputError(SOURCE, "seed", f"between 0 and 2^31 - 1; found {self.seed}")
        if not SMALLEST_CELL <= self.voxel <= LARGEST_CELL:
            raise InputError(SOURCE, "voxel", f"a cell size of {SMALLEST_CELL} to {LARGEST_CELL} m; found {self.voxel}")


def run(setting: Setting, *, done: Mapping[str, Any], on_progress: OnProgress | None = None) -> Iterator[Study]:
    """Measure row after row, and yield the study of all rows so far after each.

    Args:
        setting: split, seed, number of maps and cell size.
        done: rows that are not measured again.
        on_progress: called with (row and scene, steps done, steps).
    """
    rows, scenes = dict(done), DIVISIONS[setting.split].apartments
    maps = len(scenes) if setting.maps is None else setting.maps
    stated = asdict(setting) | {"scenes": list(scenes)}
    for name, row in ROWS.items():
        if name in rows:
            continue
        measured = {}
        for number in range(maps):
            scene = scenes[number % len(scenes)]
            measured[f"{scene} {number}"] = measure(
                scene,
                poses=row.poses,
                sensor_noise=row.sensor_noise,
                voxel=setting.voxel,
                seed=seed_of(setting.split, setting.seed, number),
                on_progress=labelled(on_progress, f"{name}: {scene}"),
            )
        rows[name] = summarise(measured)
        yield study_of({known: rows[known] for known in ROWS if known in rows}, stated)
    if rows.keys() == done.keys():
        yield study_of(rows, stated)


def finished(path: Path, setting: Setting) -> dict[str, dict[str, Any]]:
    """Return the rows of an outcome that is continued; see :func:`~vssm_gym.eval.studies.stored_rows.stored_rows`."""
    expected = "the outcome of a study of maps' reliability"
    rows = stored_rows(path, asdict(setting), StoredRow, expected)
    if not rows.keys() <= ROWS.keys():
        raise InputError(path, "content", expected)
    return rows
