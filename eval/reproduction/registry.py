"""Find out what a folder holds, a sweep or the rows of a study, and run some of its rows again."""

from collections.abc import Mapping
from pathlib import Path

from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark.manifest import MANIFEST as RUN_OF_BENCHMARK
from vssm_gym.eval.episodes.log import FILE
from vssm_gym.eval.reproduction.comparison import Reproduced
from vssm_gym.eval.reproduction.studies import STUDIES
from vssm_gym.eval.reproduction.study_rows import reproduce_study
from vssm_gym.eval.reproduction.sweep_rows import reproduce_sweep
from vssm_gym.files.output_folders import ADVICE
from vssm_gym.progress import OnProgress


def reproduce(
    folder: Path,
    out: Path,
    most: int,
    tolerance: float,
    scenes: Mapping[str, str],
    task_file: Path | None = None,
    workers: int = 2,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> list[Reproduced]:
    """Run at most so many rows of a folder again, spread evenly over it, and compare their outcomes.

    Args:
        folder: of a sweep, of a study of :data:`STUDIES`, or of a track of the benchmark.
        out: folder without rows, which gets the rows as they are now; with ``resume`` it may hold some of them.
        most: rows at most.
        tolerance: of numbers, absolute below 1 and relative above.
        scenes: files of a sweep's scenes that are not built in, by name.
        task_file: of a sweep that was given one.
        workers: processes of a sweep; the rows of a study run one after the other.
        resume: keep the rows that are in ``out``.
        on_progress: as of :func:`reproduce_sweep` and :func:`reproduce_study`.

    Raises:
        InputError: neither a sweep nor such a study, or what a row needs is not there.
    """
    if not folder.is_dir():
        raise InputError(folder, "folder", "a folder with the rows of a sweep or a study; there is none")
    held = [path.name for path in sorted(out.glob("*.jsonl")) if path.stat().st_size]
    if held and (not resume or out.resolve() == folder.resolve()):
        expected = f"a folder without rows, which are never overwritten; it holds {held[0]} ({ADVICE})"
        raise InputError(out, "folder", expected)
    if (folder / FILE).is_file():
        return reproduce_sweep(folder, out, most, tolerance, scenes, task_file, workers, resume, on_progress)
    for kind in STUDIES:
        if kind.rows(folder):
            return reproduce_study(kind, folder, out, most, tolerance, resume, on_progress)
    if (folder / RUN_OF_BENCHMARK).is_file():
        tracks = ", ".join(sorted(path.name for path in folder.iterdir() if path.is_dir()))
        raise InputError(folder, "folder", f"the folder of one track of this run of the benchmark: {tracks}")
    known = ", ".join(dict.fromkeys([FILE, *(kind.file for kind in STUDIES)]))
    raise InputError(folder, "folder", f"a sweep or a study whose rows can be run again ({known})")
