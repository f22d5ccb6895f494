"""Write files and folders atomically: under a temporary name in the same folder, then renamed."""

import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from vssm_gym.errors import OutputError

TEMPORARY = re.compile(r"\.(?P<name>.+)\.(?P<process>\d+)\.tmp")  # the names that atomic_write gives
# What a correct program may meet: no space, quota, size of a file, read-only, no permission, a fault of the disk.
REFUSALS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO}
UNEXPLAINED = {None, errno.EPIPE}  # how libraries report a refusal that they met themselves, or ffmpeg for them
PROBE = 1 << 20  # bytes that a place takes unless it refuses


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name in the folder of ``path``.

    It becomes ``path`` if the block ends; it is removed if it fails.

    A reader of ``path`` finds either the old or the complete new content, whatever interrupts this process. The
    temporary name contains the process id, so that two processes that write the same path do not interfere; the last
    one wins. What killed processes left under the temporary names of ``path`` is removed first.

    The block may make a file, which replaces a file, or a folder, which replaces at most an empty folder.

    Raises:
        OutputError: the place refuses to be written (see :func:`refusals_named`).
    """
    path = Path(path).resolve()  # "." has a name then, and a link stays a link
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with refusals_named(path, temporary):
            remove_temporaries(path.parent, path.name)
            _remove(temporary)  # left by a killed process that had this number before
            yield temporary
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):  # what cannot be written cannot always be removed either
            _remove(temporary)


@contextlib.contextmanager
def refusals_named(path: str | Path, temporary: Path | None = None) -> Iterator[None]:
    """Raise :class:`OutputError` with the path and the reason where the block cannot write to ``path``.

    A full disk, a quota, a limit on the size of files, a read-only place and missing permissions count as refusals; all
    other errors pass unchanged. Libraries report some refusals without a reason, which is then found by writing on.

    Args:
        path: file or folder that the block writes.
        temporary: the name under which it writes; None: ``path`` itself.
    """
    place = Path(path) if temporary is None else temporary
    try:
        yield
    except OutputError as error:  # of a file in the folder that this block writes
        if temporary is None or not error.path.startswith(str(temporary)):
            raise
        raise OutputError(str(path) + error.path.removeprefix(str(temporary)), error.reason) from error
    except (OSError, RuntimeError) as error:
        code, about = getattr(error, "errno", None), getattr(error, "filename", None)
        ours = about is None or str(about).startswith((str(place), str(path)))
        if code in UNEXPLAINED and ours and temporary is not None:  # which is removed in the end, with what this adds
            code = _refusal(temporary)
        if code not in REFUSALS or not ours:
            raise
        raise OutputError(path, os.strerror(code)) from error


def remove_temporaries(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes left in a folder: temporary files and folders of :func:`atomic_write`.

    Those of living processes stay, and links are never followed.

    Args:
        folder: it need not exist.
        name: of the file or folder that they were to become; None: of all, those in subfolders too.
    """
    for inside, folders, files in os.walk(folder):
        for one in (*folders, *files):
            found = TEMPORARY.fullmatch(one)
            if found and name in (None, found["name"]) and not _runs(int(found["process"])):
                with contextlib.suppress(OSError):
                    _remove(Path(inside, one))
        folders[:] = [] if name is not None else [one for one in folders if not TEMPORARY.fullmatch(one)]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OverflowError:  # a number that no process has
        return False
    except PermissionError:  # another user's
        return True
    return True


def _refusal(place: Path) -> int | None:
    """Return the number of the error with which a place refuses some more bytes; None where it takes them."""
    try:
        with (place / "probe" if place.is_dir() else place).open("ab") as file:
            file.write(bytes(PROBE))
    except OSError as error:
        return error.errno
    return None


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
