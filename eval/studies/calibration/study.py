"""Measure the rows of the calibration table one after the other; every finished row gives a complete study."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from vssm_gym.data import sequences
from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.studies.calibration.errors import summarise
from vssm_gym.eval.studies.calibration.real import rows_of
from vssm_gym.eval.studies.calibration.rows import ROWS, Given
from vssm_gym.eval.studies.calibration.split import DIVISIONS
from vssm_gym.eval.studies.calibration.table import study_of
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.progress import OnProgress

SOURCE = "study calibration"


@dataclass(frozen=True)
class Setting:
    """Hold what decides the numbers of a row; a study that is continued keeps it."""

    split: Split = "train"
    seed: int = 0
    runs: int | None = None  # of every row; None: each row's own number

    def __post_init__(self) -> None:
        if self.split not in DIVISIONS:
            raise InputError(SOURCE, "split", one_of(DIVISIONS, self.split))
        if self.runs is not None and self.runs < 1:
            raise InputError(SOURCE, "runs", f"at least 1; found {self.runs}")
        if not 0 <= self.seed < 2**31:
            raise InputError(SOURCE, "seed", f"between 0 and 2^31 - 1; found {self.seed}")


def chosen(patterns: str) -> tuple[str, ...]:
    """Return the names of the rows that match patterns with commas between them, in the table's order.

    Raises:
        InputError: a pattern that matches no row.
    """
    words = [word.strip() for word in patterns.split(",") if word.strip()]
    for word in words:
        if not any(fnmatchcase(name, word) for name in ROWS):
            raise InputError(SOURCE, "rows", f"names or patterns of {', '.join(ROWS)}; found {word!r}")
    return tuple(name for name in ROWS if any(fnmatchcase(name, word) for word in words))


def checked(recordings: Sequence[sequences.Sequence], names: Sequence[str]) -> Sequence[sequences.Sequence]:
    """Return the recordings.

    Raises:
        InputError: no recording and no row, two recordings of one name, or one without ground truth.
    """
    if not recordings and not names:
        raise InputError(SOURCE, "rows", "rows or sequences to measure")
    found = [name_of(recording) for recording in recordings]
    if len(set(found)) < len(found):
        raise InputError(SOURCE, "sequences", f"folders of different names; found {', '.join(found)}")
    for recording in recordings:
        if recording.truth is None:
            raise InputError(recording.root / "groundtruth.txt", "file", "ground-truth poses, which this study needs")
    return recordings


def name_of(recording: sequences.Sequence) -> str:
    """Return the label of a recording's rows."""
    return recording.root.resolve().name


def run(
    recordings: Sequence[sequences.Sequence],
    names: Sequence[str],
    setting: Setting,
    *,
    folder: Path,
    done: Mapping[str, Any],
    on_progress: OnProgress | None = None,
) -> Iterator[Study]:
    """Measure row after row, and yield the study of all rows so far after each.

    Args:
        recordings: as :func:`checked`; each gives rows of its own.
        names: of the simulated rows.
        setting: split, seed and number of runs.
        folder: for learned maps, which are kept.
        done: rows that are not measured again.
        on_progress: called with (row, runs done, runs).

    Raises:
        InputError: a recording that is never tracked, or an apartment without the drives that a row asks for.
    """
    rows = dict(done)
    stated = asdict(setting) | {"scenes": asdict(DIVISIONS[setting.split])}
    notices = tuple(notice for recording in recordings for notice in recording.notices)
    for name in names:
        if name not in rows:
            rows[name] = measure_row(name, setting, folder, on_progress)
            yield study_of(_in_order(rows), stated, notices)
    for recording in recordings:
        name = name_of(recording)
        if name not in rows:
            rows |= rows_of(name, recording, labelled(on_progress, name))
            yield study_of(_in_order(rows), stated, notices)
    if rows.keys() == done.keys():
        yield study_of(_in_order(rows), stated, notices)


def _in_order(rows: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rows in the table's order, whatever was measured first; those of recordings come last."""
    return {name: rows[name] for name in (*ROWS, *rows) if name in rows}


def measure_row(name: str, setting: Setting, folder: Path, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Measure a row of simulated runs; maps that it needs are learned in ``folder`` and kept."""
    row = ROWS[name]
    runs = row.runs if setting.runs is None else setting.runs

    def on_run(count: int) -> None:
        if on_progress:
            on_progress(name, count, runs)

    given = Given(runs, setting.split, setting.seed, folder, on_run, labelled(on_progress, f"{name}: map"))
    return summarise(row.measure(given)) | {"about": row.about}
