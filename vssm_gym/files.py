"""Files and folders that appear whole or not at all: written under another name beside their place, then renamed."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """A name to write to, in the folder of ``path``; it becomes ``path`` if the block ends, and is removed if it fails.

    Whoever reads ``path`` finds what was there before or what was written, never half of it, whatever interrupts this
    process. The name is the process's own, so two that write the same path do not mix; the last one wins.

    The block may make a file, which replaces a file, or a folder, which takes the place of an empty folder at most.
    """
    path = Path(path).resolve()  # "." has a name then, and a link stays a link
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    _remove(temporary)  # left by a killed process that had this number before
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
