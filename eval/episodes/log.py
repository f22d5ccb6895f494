"""Read and write an episode log, ``episodes.jsonl``: one JSON object a line, one line an episode.

A line is on disk before the next episode starts.
A process that is killed while it writes leaves at most one unfinished last line. Opening the log drops that line, and
only that line; anything else that cannot be read is an error, never silently skipped. Each row is held to the schema of
:mod:`vssm_gym.eval.episodes.row` when it is written and when it is read.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from vssm_gym.agents.renamed import current_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.manifest import MANIFEST, completed, read_manifest
from vssm_gym.eval.episodes.row import DEFAULTS, KEY, checked, identified, written
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.json_file import parse_json_lines
from vssm_gym.files.line_file import LineFile, whole_lines

FILE = "episodes.jsonl"
LOG_BYTES = 256 << 20  # 200,000 episodes


def episode_key(row: Mapping[str, Any]) -> tuple:
    """Return the identity of an episode among all others of a sweep."""
    return tuple(identified(row, name) for name in (*KEY, *DEFAULTS))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read every finished episode of a log, in the order of writing; an unfinished last line is ignored.

    Rows that leave out what all rows of the sweep share are completed from the ``sweep.json`` in the same folder.
    Agents that were renamed since have their present names; the file keeps what was written.

    Raises:
        InputError: the file is missing, a line is not an episode, or an episode appears twice.
    """
    if not path.is_file():
        raise InputError(path, "file", "an episode log; `vssm-gym sweep` writes one")
    return _parse(path, whole_lines(read_bytes(path, LOG_BYTES)))


def _parse(path: Path, data: bytes) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    seen: dict[tuple, int] = {}
    manifest: dict[str, Any] | None = None
    for number, row in parse_json_lines(data, path, "one episode"):
        if missing := [name for name in KEY if name not in row]:
            if not (path.parent / MANIFEST).is_file():
                expected = f"one episode as JSON with {', '.join(KEY)}; there is no {missing[0]}"
                raise InputError(path, f"line {number}", expected)
            manifest = manifest or read_manifest(path.parent / MANIFEST)
            row = completed(row, manifest)
        try:
            row = checked(row)
        except ValidationError as error:
            problem = error.errors()[0]
            field = ".".join(str(part) for part in problem["loc"])
            expected = f"one episode as JSON; {field}: {problem['msg'].removeprefix('Input should be ')}"
            raise InputError(path, f"line {number}", expected) from error
        row["agent"] = current_name(row["agent"])
        key = episode_key(row)
        if key in seen:
            raise InputError(path, f"line {number}", f"each episode once; it repeats line {seen[key]}")
        seen[key] = number
        rows.append(row)
    return rows


def line_of(row: dict[str, Any]) -> bytes:
    """Return the line of a log that holds a row."""
    return json.dumps(row, allow_nan=False, separators=(",", ":")).encode() + b"\n"


class EpisodeLog:
    """Write a log, in a folder that this process owns. ``rows`` are its episodes, earlier processes' included."""

    def __init__(self, path: Path) -> None:
        whole = whole_lines(read_bytes(path, LOG_BYTES)) if path.exists() else b""
        self.rows = _parse(path, whole)
        self._file = LineFile(path, keep=len(whole))

    def append(self, row: dict[str, Any]) -> None:
        """Add one finished episode; it survives a power cut once this returns.

        Raises ValueError for a row that does not fit the schema, and OutputError where it cannot be written; the log is
        as before then.
        """
        row = written(row)
        self._file.append(line_of(row), sync=True)
        self.rows.append(row)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()
