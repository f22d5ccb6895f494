"""Append lines to a file, each of which is written whole or not at all."""

import contextlib
import os
from pathlib import Path
from typing import Self

from vssm_gym.files.atomic import refusals_named


def whole_lines(data: bytes) -> bytes:
    """Return a file up to the last line that ended; a crash of the machine may also leave a last line of zeros."""
    whole = data[: data.rfind(b"\n") + 1]
    last = whole[:-1].rpartition(b"\n")[2]
    return whole[: len(whole) - len(last) - 1] if b"\0" in last else whole


class LineFile:
    """Append lines to a file that is kept open; a line that cannot be written whole is taken back.

    A process that is killed while it writes leaves at most one unfinished last line.
    """

    def __init__(self, path: Path, keep: int | None = None) -> None:
        """Open or make the file; drop all but its first ``keep`` bytes (None: keep all)."""
        self.path = path
        with refusals_named(path):
            self._file = path.open("ab", buffering=0)
            self._size = self._file.tell()
            if keep is not None:
                self.truncate(keep)

    def append(self, line: bytes, sync: bool = False) -> None:
        """Add ``line``, which ends in a newline; with ``sync`` it survives a power cut once this returns.

        Raises:
            OutputError: a full disk or the like; the file is as before then, and later lines may still fit.
        """
        with refusals_named(self.path):
            try:
                rest = memoryview(line)
                while rest:
                    rest = rest[self._file.write(rest) :]
                if sync:
                    os.fsync(self._file.fileno())
            except OSError:
                with contextlib.suppress(OSError):
                    self._file.truncate(self._size)
                raise
        self._size += len(line)

    def truncate(self, size: int) -> None:
        """Drop all but the first ``size`` bytes."""
        self._file.truncate(size)
        self._size = size

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
