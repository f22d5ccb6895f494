"""Check arguments that would otherwise fail after the work is done: output folders, seeds, workers."""

import os
from pathlib import Path

from vssm_gym.errors import InputError


def check_folder(path: Path) -> None:
    """Raise :class:`InputError` unless ``path`` is a folder that can be written or one that can be made; makes none."""
    nearest = next(p for p in (path.absolute(), *path.absolute().parents) if os.path.lexists(p))
    if not nearest.is_dir():
        raise InputError(path, "folder", f"a folder or the name of a new one; {nearest} is a file")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(path, "folder", f"a folder that can be written; {nearest} cannot")


def check_file(path: Path) -> None:
    """Raise :class:`InputError` unless a file can be written at ``path``, in a folder that exists; writes none."""
    if path.is_dir():
        raise InputError(path, "file", "the name of a file to write; it is a folder")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(path, "folder", "a folder that exists and can be written")


def check_at_least(command: str, field: str, value: int, least: int) -> None:
    """Raise :class:`InputError` where ``value`` is below ``least``."""
    if value < least:
        raise InputError(command, field, f"at least {least}, found {value}")
