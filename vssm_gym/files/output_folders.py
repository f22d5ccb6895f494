"""Own an output folder: one run writes to it at a time, and nothing that another run wrote is ever replaced.

A folder that grows while a run works belongs to the run whose manifest it holds: ``sweep.json``, ``training.json``,
``slam.json`` and so on, which state the command and a hash of its configuration. A run of the same configuration
continues there, or begins anew where nothing is lost by it; every other run is refused. A folder that is written whole
(:func:`whole_folder`) appears when it is complete. Nobody's files are removed, except the temporary ones of processes
that were killed.
"""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError, OutputError
from vssm_gym.files.atomic import TEMPORARY, atomic_write, refusals_named, remove_temporaries
from vssm_gym.files.json_file import read_json

LOCK = ".lock"  # in a folder while a run owns it, and the end of the lock beside a folder that is written whole
ADVICE = "choose another folder, or delete it yourself"
RESUME = "--resume continues it, resume=True in a program"


@dataclass(frozen=True)
class Owner:
    """Describe the run that wants to own a folder.

    Attributes:
        what: it writes, in words: "sweep".
        manifest: name of its manifest.
        content: of the manifest, as plain JSON values.
        identity: fields of ``content`` in which two runs agree that may write to one folder.
        resumed: files with work that only ``--resume`` continues; without it they are refused.
        finished: file of a run that has ended, which is never repeated; None: a run may repeat.
    """

    what: str
    manifest: str
    content: Mapping[str, Any]
    identity: tuple[str, ...] = ("config_hash",)
    resumed: tuple[str, ...] = ()
    finished: str | None = None


@contextlib.contextmanager
def owned_folder(out: Path, owner: Owner, resume: bool = False) -> Iterator[None]:
    """Own ``out`` while the block runs.

    The folder is made, locked against other runs, freed from temporary files of killed processes, and marked with the
    owner's manifest. If the block leaves nothing there, neither does this.

    Args:
        out: a new or empty folder, or one that an equal owner wrote to.
        owner: the run.
        resume: whether it continues what ``owner.resumed`` names.

    Raises:
        InputError: the folder is another run's, or not a run's at all; one is running in it; it holds what this run
            would replace. The folder is left as it is.
        OutputError: it cannot be written.
    """
    check_folder(out)
    if not (out / LOCK).is_file() or (out / LOCK).is_symlink():  # of a run that is running, or was killed
        _check_owner(out, owner, resume)
    made = not out.exists()
    with _entries_refused(out):
        out.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(out / LOCK, out):
            _check_owner(out, owner, resume)
            remove_temporaries(out)
            if not any(_has_data(out / name) for name in owner.resumed):
                with atomic_write(out / owner.manifest) as temporary:
                    temporary.write_text(json.dumps(owner.content, indent=1) + "\n", encoding="utf-8")
            try:
                yield
            finally:
                if not _data(out, owner.manifest):
                    (out / owner.manifest).unlink(missing_ok=True)
    finally:
        if made:
            with contextlib.suppress(OSError):  # where it is not empty
                out.rmdir()


@contextlib.contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Yield an empty folder to write into, which becomes ``out`` when the block ends without an error.

    Raises:
        InputError: ``out`` is not a new or empty folder, or another run is writing it.
        OutputError: it cannot be written.
    """
    check_new_folder(out)
    with _entries_refused(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    target = out.resolve()  # a link to an empty folder stays one
    with _locked(target.with_name(f".{target.name}{LOCK}"), out):
        check_new_folder(out)
        with atomic_write(target) as unfinished:
            unfinished.mkdir()
            yield unfinished


def check_folder(path: Path) -> None:
    """Raise :class:`InputError` unless ``path`` is a folder that can be written or one that can be made; makes none."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:  # a name that is too long, in a folder that may not be searched
        raise InputError(path, "folder", f"the name of a folder ({error.strerror})") from error
    nearest = next(p for p in (path.absolute(), *path.absolute().parents) if os.path.lexists(p))
    if not nearest.is_dir():
        raise InputError(path, "folder", f"a folder or the name of a new one; {nearest} is a file")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(path, "folder", f"a folder that can be written; {nearest} cannot")


def check_new_folder(path: Path) -> None:
    """Raise :class:`InputError` unless ``path`` is a folder that can be made, or an empty one; makes none."""
    check_folder(path)
    held = [one.name for one in path.iterdir()] if path.is_dir() else []  # any file would stop the rename in the end
    if held:
        expected = f"a new or empty folder: nothing is ever overwritten; it holds {min(held)} ({ADVICE})"
        raise InputError(path, "folder", expected)


def check_file(path: Path, endings: tuple[str, ...] = (), inputs: Iterable[Path] = ()) -> None:
    """Raise :class:`InputError` unless a file can be written at ``path``, in a folder that exists; writes none.

    A file that is there is replaced, so it may not be one of the ``inputs``, and its name has to end as it will: a
    mistake between the arguments then costs nothing.
    """
    if path.is_dir():
        raise InputError(path, "file", "the name of a file to write; it is a folder")
    if endings and path.suffix.lower() not in endings:
        raise InputError(path, "file", f"a name that ends in {' or '.join(endings)}")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(path, "folder", "a folder that exists and can be written")
    for read in inputs:
        if path.exists() and read.exists() and path.samefile(read):
            raise InputError(path, "file", f"another file than the input {read}, which is never overwritten")


def check_new_file(path: Path, endings: tuple[str, ...] = ()) -> None:
    """Raise :class:`InputError` unless a new file can be written at ``path``, for what takes long to make again."""
    check_file(path, endings)
    if os.path.lexists(path):
        raise InputError(path, "file", f"a new file: this one is never overwritten ({ADVICE})")


def check_at_least(command: str, field: str, value: int, least: int) -> None:
    """Raise :class:`InputError` where ``value`` is below ``least``."""
    if value < least:
        raise InputError(command, field, f"at least {least}, found {value}")


def _check_owner(out: Path, owner: Owner, resume: bool) -> None:
    """Raise :class:`InputError` where ``out`` holds data that ``owner`` may not write beside."""
    path = out / owner.manifest
    for one in (path, out / LOCK):
        if os.path.lexists(one) and (one.is_symlink() or not one.is_file()):  # a link leads to a file elsewhere
            raise InputError(one, "file", f"an ordinary file, as a {owner.what} writes it ({ADVICE})")
    held = _data(out, owner.manifest)
    if not held:
        return
    if not path.is_file():
        expected = f"a new or empty folder, or that of a {owner.what}, which has a {owner.manifest}; it holds {held[0]}"
        raise InputError(out, "folder", f"{expected} ({ADVICE})")
    found = read_json(path, expected=f"the JSON that a {owner.what} wrote")
    for name in owner.identity:
        wanted, there = owner.content.get(name), found.get(name) if isinstance(found, dict) else None
        if there != wanted:
            expected = f"{wanted}, as of this configuration; found {there}{_difference(owner.content, found)}"
            raise InputError(path, name, f"{expected}: another {owner.what} belongs into another folder ({ADVICE})")
    if owner.finished is not None and (out / owner.finished).exists():
        raise InputError(out, "folder", f"a new or empty folder: a finished run is never overwritten ({ADVICE})")
    for name in owner.resumed:
        if not resume and _has_data(out / name):
            expected = f"a folder without a {owner.what}; it holds {name}"
            raise InputError(out, "folder", f"{expected} ({RESUME}; or {ADVICE})")


def _difference(wanted: Mapping[str, Any], found: Any) -> str:
    """Return the first field in which the configurations of two manifests differ, in words; empty without one."""
    here, there = (one.get("config") if isinstance(one, Mapping) else None for one in (wanted, found))
    if not (isinstance(here, Mapping) and isinstance(there, Mapping)):
        return ""
    differing = (name for name in here if json.dumps(here[name]) != json.dumps(there.get(name)))
    name = next(differing, None)
    return "" if name is None else f", where {name} is {json.dumps(there.get(name)):.80}"


def _data(out: Path, manifest: str) -> list[str]:
    """Return the names in a folder that hold data, sorted; manifests, locks, temporaries and empty files hold none."""
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    return [name for name in names if name != manifest and not _passes(name) and _has_data(out / name)]


def _has_data(path: Path) -> bool:
    """Return whether a path is a file that is not empty, a link, or a folder with either in it."""
    if path.is_dir() and not path.is_symlink():
        return any(not _passes(one.name) and _has_data(one) for one in path.iterdir())
    return os.path.lexists(path) and (path.is_symlink() or path.stat().st_size > 0)


def _passes(name: str) -> bool:
    """Return whether a file of this name is a lock or a temporary file, which no run needs when it has ended."""
    return bool(TEMPORARY.fullmatch(name)) or (name.startswith(".") and name.endswith(LOCK))


@contextlib.contextmanager
def _entries_refused(path: Path) -> Iterator[None]:
    """Raise :class:`OutputError` where the block cannot make ``path``, or the folders above it.

    File systems that the kernel fills itself (/proc) say that there is no such file.
    """
    try:
        with refusals_named(path):
            yield
    except FileNotFoundError as error:
        raise OutputError(path, "nothing can be made in this folder") from error


@contextlib.contextmanager
def _locked(path: Path, out: Path) -> Iterator[None]:
    """Hold an exclusive lock, which the system releases with the process, however that ends.

    Raises:
        InputError: another run holds it; ``out`` is the folder that both want.
    """
    file = _lock_file(path, out)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        os.close(file)


def _lock_file(path: Path, out: Path) -> int:
    """Return the descriptor of the locked file; the owner before may remove the file between opening and locking."""
    while True:
        with _entries_refused(path):
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            with refusals_named(path):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(file), path.stat()):
                return file
        except BlockingIOError as error:
            os.close(file)
            expected = "no other run writing to it at the same time; wait for it, or choose another folder"
            raise InputError(out, "folder", expected) from error
        except BaseException:
            os.close(file)
            raise
        os.close(file)
