"""Keep what each track of a benchmark took, over all runs that continue its folder."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.eval.sweep.supervision import processor_seconds
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.json_file import read_json

FILE = "times.json"  # in the folder of a benchmark


class Took(StrictModel):
    """Hold seconds on the clock, and of the processor with those of all workers, for all entries of a track."""

    wall_seconds: float = 0.0
    processor_seconds: float = 0.0


class Times(StrictModel):
    """Hold what each track took, by its name."""

    tracks: dict[str, Took]


def read_times(folder: Path) -> dict[str, Took]:
    """Return what each track took so far; raise :class:`InputError` for a file of something else."""
    path = folder / FILE
    if not path.is_file():
        return {}
    return validated(Times, read_json(path, expected="the JSON that a benchmark wrote"), path).tracks


@contextlib.contextmanager
def timed(folder: Path, name: str) -> Iterator[None]:
    """Add what the block takes to the track's time, also of a block that is interrupted."""
    wall, processor = time.perf_counter(), processor_seconds()
    try:
        yield
    finally:
        found = read_times(folder)
        before = found.get(name, Took())
        found[name] = Took(
            wall_seconds=round(before.wall_seconds + time.perf_counter() - wall, 1),
            processor_seconds=round(before.processor_seconds + processor_seconds() - processor, 1),
        )
        with atomic_write(folder / FILE) as temporary:
            temporary.write_text(Times(tracks=found).model_dump_json(indent=1) + "\n", encoding="utf-8")
