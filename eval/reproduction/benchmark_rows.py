"""Run rows of the benchmark's tracks of SLAM and prediction again; those of agents are rows of sweeps.

An entry runs the whole track once more, by the command's own code, for all of its rows that are compared. Suites and
entries are those of the package.
"""

import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark.manifest import MANIFEST, read_manifest
from vssm_gym.eval.benchmark.run import run_benchmark
from vssm_gym.eval.benchmark.suite import suite_file
from vssm_gym.eval.benchmark.units import ROWS
from vssm_gym.eval.reproduction.study_rows import StudyRows, read_lines

Row = Mapping[str, Any]


def _rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a track's folder with its name and the suite's; none in a folder of something else."""
    run = path.parent.parent
    if not (run / MANIFEST).is_file():
        return []
    stated = {"suite": read_manifest(run).suite, "track": path.parent.name}
    return [stated | row for row in read_lines(path)]


@cache
def _runs(suite: str, track: str, entry: str) -> dict[str, dict[str, Any]]:
    """Return an entry's rows of a track by their units."""
    with tempfile.TemporaryDirectory(prefix="vssm-gym-benchmark-") as scratch:
        out = Path(scratch) / "run"
        run_benchmark(suite_file(suite), [entry], out, tracks=[track])
        return {row["unit"]: row for row in read_lines(out / track / ROWS)}


def _again(row: Row) -> dict[str, Any]:
    found = _runs(row["suite"], row["track"], row["entry"])
    if row["unit"] not in found:
        raise InputError("benchmark", "unit", f"one of {', '.join(found)}; found {row['unit']!r:.80}")
    return found[row["unit"]]


BENCHMARK = StudyRows(
    "benchmark", ROWS, ("suite", "track", "entry", "unit"), _again, frozenset({"p95", "version"}), _rows
)
"""The rows of a track of SLAM or prediction, in the track's folder of a run."""
