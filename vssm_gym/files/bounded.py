"""Read the content of users' files: ordinary files only, of a known size, inside the folder that they belong to."""

import io
import os
import stat
from pathlib import Path
from typing import BinaryIO

from vssm_gym.errors import InputError

LINE_BYTES = 100_000  # of a line of numbers or names; those of recordings have a few hundred


def open_file(path: str | Path, expected: str = "a readable file") -> BinaryIO:
    """Open an ordinary file for reading; a pipe, a device or a folder is refused without waiting for it.

    Args:
        path: the file.
        expected: what the caller reads, for the error.

    Raises:
        InputError: no such file, none that may be read, or no ordinary file.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(path, "file", f"{expected} ({getattr(error, 'strerror', None) or error})") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        found = "a folder" if stat.S_ISDIR(mode) else "no ordinary file"
        raise InputError(path, "file", f"{expected}; this is {found}")
    return os.fdopen(descriptor, "rb")


def is_file(path: str | Path) -> bool:
    """Return True for an existing ordinary file; False also for a name that no file can have."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def read_bytes(path: str | Path, limit: int, expected: str = "a readable file") -> bytes:
    """Return the file's content; raise InputError where it cannot be read or has more than ``limit`` bytes."""
    with open_file(path, expected) as file:
        try:
            content = file.read(limit + 1)
        except OSError as error:
            raise InputError(path, "file", f"{expected} ({error.strerror})") from error
    if len(content) > limit:
        raise InputError(path, "file", f"at most {limit:,} bytes")
    return content


def read_text(path: str | Path, limit: int, expected: str = "a text file") -> str:
    """Return the file's text in UTF-8; raise InputError as :func:`read_bytes` does, or for other bytes."""
    try:
        return read_bytes(path, limit, expected).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(path, "file", f"{expected}, in UTF-8") from error


def check_lines(content: bytes, most: int, source: object) -> None:
    """Raise InputError for content with more than ``most`` lines, or with one of more than ``LINE_BYTES`` bytes.

    As Python objects a line takes up to a hundred times its bytes, so that a bound of the file's size is not enough.
    """
    if max(content.count(b"\n"), content.count(b"\r")) > most:
        raise InputError(source, "lines", f"at most {most:,} of them")
    if max(map(len, io.BytesIO(content)), default=0) > LINE_BYTES:
        raise InputError(source, "lines", f"at most {LINE_BYTES:,} bytes in each of them")


def inside(folder: Path, name: str, source: object, field: str) -> Path:
    """Return ``folder / name``; raise InputError for a name that leaves the folder or that no file can have.

    Only the name is checked: a link inside the folder that its owner made is followed.
    """
    path = Path(name)
    if "\0" in name or not name or path.is_absolute() or ".." in path.parts:
        raise InputError(source, field, f"the name of a file inside {folder}; found {name!r:.200}")
    return folder / path
