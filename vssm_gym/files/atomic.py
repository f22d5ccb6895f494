"""Write files and folders atomically: under a temporary name in the same folder, then renamed."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name in the folder of ``path``.

    It becomes ``path`` if the block ends; it is removed if it fails.

    A reader of ``path`` finds either the old or the complete new content, whatever interrupts this process. The
    temporary
    name contains the process id, so that two processes that write the same path do not interfere; the last one wins.

    The block may make a file, which replaces a file, or a folder, which replaces at most an empty folder.
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
