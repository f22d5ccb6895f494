"""Run some rows of a study again, one by one, and compare each; a kind of study says how one row is run."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vssm_gym.eval.reproduction.comparison import Reproduced, first_difference, spread_evenly
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.json_file import parse_json_lines
from vssm_gym.files.line_file import LineFile, whole_lines
from vssm_gym.files.output_folders import Owner, owned_folder
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version

STUDY_BYTES = 64 << 20  # of a file of rows; those of the package have 0.3 MB
Figures = Mapping[str, Any]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file with one JSON object a line."""
    return [row for _, row in parse_json_lines(read_bytes(path, STUDY_BYTES), path, "a row of a study")]


@dataclass(frozen=True)
class StudyRows:
    """Define the rows of a kind of study.

    Attributes:
        name: of the study, for messages.
        file: of the rows in the study's folder; a pattern where a study was run in parts.
        identity: fields that say what was run; a row that has them all is of this kind, and any other is left out.
        again: runs a row's identity and conditions once more; returns its figures. It may raise InputError.
        made_by: fields that say by what, when and how fast a row was made, and are not compared.
        read: returns the rows of one such file.
        release: called after every row: what many runs pile up in a process.
    """

    name: str
    file: str
    identity: tuple[str, ...]
    again: Callable[[Figures], Figures]
    made_by: frozenset[str]
    read: Callable[[Path], list[dict[str, Any]]] = read_lines
    release: Callable[[], None] = field(default=lambda: None)

    def rows(self, folder: Path) -> list[dict[str, Any]]:
        """Return the rows of this kind that a folder holds."""
        found = [row for path in sorted(folder.glob(self.file)) for row in self.read(path)]
        return [row for row in found if set(self.identity) <= row.keys()]

    def words(self, row: Figures) -> str:
        """Return what was run in words."""
        return ", ".join(f"{name} {row[name]}" for name in self.identity)


def reproduce_study(
    kind: StudyRows,
    folder: Path,
    out: Path,
    most: int,
    tolerance: float,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> list[Reproduced]:
    """Run rows of a study again, spread evenly over it, write them to ``out``, and compare them.

    Args:
        kind: of the study.
        folder: with its file of rows, one of this kind at least.
        out: new or empty folder; it gets the rows as they are now, one a line. With ``resume`` it may hold some.
        most: rows at most.
        tolerance: see :func:`first_difference`.
        resume: keep the rows that this version has written to ``out``, and run the others.
        on_progress: called with ("rows", done, rows).
    """
    chosen, outcome = spread_evenly(kind.rows(folder), most), []
    lines = out / f"{Path(kind.file.replace('*', '')).stem}.jsonl"
    content = {"study": kind.name, "version": package_version()}
    owner = Owner("reproduce", "reproduce.json", content, identity=("study", "version"), resumed=(lines.name,))
    with owned_folder(out, owner, resume):
        kept = whole_lines(read_bytes(lines, STUDY_BYTES)) if lines.is_file() else b""
        before = {kind.words(row): row for _, row in parse_json_lines(kept, lines, "a row of a study")}
        with LineFile(lines, keep=len(kept)) as file:
            for done, row in enumerate(chosen):
                if on_progress:
                    on_progress("rows", done, len(chosen))
                found = before.get(kind.words(row))
                if found is None:
                    found = {name: row[name] for name in kind.identity} | dict(kind.again(row))
                    file.append((json.dumps(found) + "\n").encode())
                    kind.release()
                version = row.get("version", row.get("code"))
                compared = {
                    name: value for name, value in row.items() if name not in kind.made_by and name not in kind.identity
                }
                outcome.append(Reproduced(kind.words(row), first_difference(compared, found, tolerance), version))
    return outcome
