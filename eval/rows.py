"""``episodes.jsonl``: one JSON object a line, one line an episode; the line is on disk before the next episode starts.

A process that is killed while it writes leaves at most one unfinished last line. Opening the log drops that line, and
only that line; anything else that cannot be read is an error, never silently skipped.
"""

import fcntl
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from vssm_gym.errors import InputError

FILE = "episodes.jsonl"
KEY = ("env", "scene_hash", "robot", "noise", "sensor_noise", "renderer", "physics", "task", "seed", "agent")
"""The fields that identify an episode; each combination appears once in a log."""


def episode_key(row: Mapping[str, Any]) -> tuple:
    """The identity of an episode among all others of a sweep."""
    return tuple(row[name] for name in KEY)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Every finished episode of a log, in the order of writing; an unfinished last line is ignored.

    Raises:
        InputError: the file is missing, a line is not an episode, or an episode appears twice.
    """
    if not path.is_file():
        raise InputError(path, "file", "an episode log; `vssm-gym sweep` writes one")
    return _parse(path, _whole_lines(path.read_bytes()))


def _whole_lines(data: bytes) -> bytes:
    """The log up to the last line that ended; a crash of the machine may also leave a last line of zeros."""
    whole = data[: data.rfind(b"\n") + 1]
    last = whole[:-1].rpartition(b"\n")[2]
    return whole[: len(whole) - len(last) - 1] if b"\0" in last else whole


def _parse(path: Path, data: bytes) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    seen: dict[tuple, int] = {}
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            row = json.loads(line)
            key = episode_key(row)
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(path, f"line {number}", f"one episode as JSON with {', '.join(KEY)} ({error})") from error
        if key in seen:
            raise InputError(path, f"line {number}", f"each episode once; it repeats line {seen[key]}")
        seen[key] = number
        rows.append(row)
    return rows


class EpisodeLog:
    """The one writer of a log. ``rows`` are the episodes that it holds, those of an earlier process included.

    An exclusive lock keeps a second sweep from writing the same episodes again; the system releases it with the
    process, however the process ends.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            raise InputError(path, "file", "no other sweep writing it at the same time") from error
        whole = _whole_lines(path.read_bytes())
        try:
            self.rows = _parse(path, whole)
        except InputError:
            self._file.close()
            raise
        self._file.truncate(len(whole))

    def append(self, row: dict[str, Any]) -> None:
        """Add one finished episode; it survives a power cut once this returns."""
        self._file.write(json.dumps(row, allow_nan=False, separators=(",", ":")).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.rows.append(row)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()
