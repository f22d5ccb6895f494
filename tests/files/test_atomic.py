"""Test atomic writes: at every moment the old file or the complete new one exists, and no other remains."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.chaos.disks import largest_file
from vssm_gym.errors import OutputError
from vssm_gym.eval.video.writer import write_frames
from vssm_gym.files.atomic import atomic_write, remove_temporaries


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


@pytest.mark.parametrize("before", ["old", None])
def test_the_file_changes_at_the_end_and_at_once(tmp_path: Path, before: str | None) -> None:
    path = tmp_path / "file.txt"
    if before is not None:
        path.write_text(before)
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == path.parent  # a rename is atomic within a file system only
        assert (path.read_text() if path.exists() else None) == before
    assert path.read_text() == "new" and names(tmp_path) == ["file.txt"]


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", ["old", None])
def test_a_failure_keeps_the_old_file_and_nothing_else(
    tmp_path: Path, before: str | None, error: BaseException
) -> None:
    path = tmp_path / "file.txt"
    if before is not None:
        path.write_text(before)
    with pytest.raises(type(error)), atomic_write(path) as temporary:
        temporary.write_text("half of the new")
        raise error
    assert names(tmp_path) == ([] if before is None else ["file.txt"])
    assert before is None or path.read_text() == before


def test_a_failed_rename_cleans_up_too(tmp_path: Path) -> None:
    path = tmp_path / "taken"
    path.mkdir()
    with pytest.raises(OSError, match="taken"), atomic_write(path) as temporary:
        temporary.write_text("a file cannot replace a folder")
    assert names(tmp_path) == ["taken"] and names(path) == []


@pytest.mark.parametrize("exists", [False, True])
def test_a_folder_appears_complete(tmp_path: Path, exists: bool) -> None:
    path = tmp_path / "folder"
    if exists:
        path.mkdir()
    with atomic_write(path) as temporary:
        (temporary / "deep").mkdir(parents=True)
        (temporary / "deep" / "a").write_text("a")
        assert not path.exists() or names(path) == []
    assert names(path) == ["deep"] and names(tmp_path) == ["folder"]


def test_a_failed_folder_is_removed_completely(tmp_path: Path) -> None:
    path = tmp_path / "folder"
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        (temporary / "deep").mkdir(parents=True)
        raise RuntimeError
    assert names(tmp_path) == []
    path.mkdir()
    (path / "kept").write_text("old")
    with pytest.raises(OSError, match="folder"), atomic_write(path) as temporary:
        temporary.mkdir()
    assert names(path) == ["kept"] and names(tmp_path) == ["folder"]


def test_files_of_a_killed_process_are_replaced(tmp_path: Path) -> None:
    """Process ids repeat, above all in containers."""
    path = tmp_path / "folder"
    with atomic_write(path) as temporary:
        temporary.mkdir()
    path.rmdir()
    temporary.mkdir()
    (temporary / "left over").write_text("half")
    with atomic_write(path) as again:
        assert again == temporary and not again.exists()
        again.mkdir()
    assert names(path) == []


def test_two_processes_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file.txt"
    with atomic_write(path) as mine:
        mine.write_text("mine")
        monkeypatch.setattr(os, "getpid", lambda: -1)
        with atomic_write(path) as theirs:
            theirs.write_text("theirs")
        assert path.read_text() == "theirs" and mine.read_text() == "mine"
    assert path.read_text() == "mine" and names(tmp_path) == ["file.txt"]


def test_paths_without_a_name_and_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    with atomic_write(".") as temporary:
        temporary.mkdir()
        (temporary / "a").write_text("a")
    assert names(tmp_path / "empty") == ["a"]
    (tmp_path / "target.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("target.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "target.txt").read_text() == "new"


DEAD = 2**22 + 1  # above the largest number that Linux gives a process


def test_what_killed_processes_left_of_this_path_is_removed_and_nothing_else(tmp_path: Path) -> None:
    left, living = tmp_path / f".map.npz.{DEAD}.tmp", tmp_path / f".map.npz.{os.getppid()}.tmp"
    other, folder = tmp_path / f".mesh.ply.{DEAD}.tmp", tmp_path / "deep" / f".map.npz.{DEAD}.tmp"
    folder.mkdir(parents=True)
    for path in (left, living, other):
        path.write_text("half")
    with atomic_write(tmp_path / "map.npz") as temporary:
        temporary.write_text("new")
    assert not left.exists() and living.exists() and other.exists() and folder.exists()


def test_temporaries_are_removed_in_subfolders_too_and_links_are_not_followed(tmp_path: Path) -> None:
    elsewhere, out = tmp_path / "elsewhere", tmp_path / "out"
    half = f".oak.{DEAD}.tmp"
    for folder in (elsewhere, out / "recordings" / half):
        folder.mkdir(parents=True)
        (folder / half).write_text("half")
    (out / "maps").symlink_to(elsewhere)
    (out / f".link.{DEAD}.tmp").symlink_to(elsewhere)
    (out / ".hidden").write_text("mine")
    remove_temporaries(out)
    assert names(out) == [".hidden", "maps", "recordings"] and names(out / "recordings") == []
    assert names(elsewhere) == [half]


def test_a_refusal_names_the_file_and_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    path.write_text("old")
    message = r"map\.npz: could not be written: File too large$"
    with largest_file(1000), pytest.raises(OutputError, match=message), atomic_write(path) as temporary:
        temporary.write_bytes(bytes(2000))
    assert names(tmp_path) == ["map.npz"] and path.read_text() == "old"
    os.chmod(tmp_path, 0o500)
    try:
        if not os.access(tmp_path, os.W_OK):  # not for root, whom nothing refuses
            with pytest.raises(OutputError, match="Permission denied"), atomic_write(path) as temporary:
                temporary.write_text("new")
    finally:
        os.chmod(tmp_path, 0o700)


def test_a_refusal_in_a_folder_names_the_file_in_it(tmp_path: Path) -> None:
    with (
        largest_file(1000),
        pytest.raises(OutputError, match=r"/drive/camera\.json: could not be written: File too large$"),
        atomic_write(tmp_path / "drive") as folder,
    ):
        folder.mkdir()
        with atomic_write(folder / "camera.json") as temporary:
            temporary.write_bytes(bytes(2000))
    assert names(tmp_path) == []


@pytest.mark.parametrize("error", [OSError("2000 requested and 1000 written"), BrokenPipeError(32, "Broken pipe")])
def test_a_library_that_says_no_reason_is_given_one(tmp_path: Path, error: OSError) -> None:
    """As NumPy does, and as imageio does when ffmpeg has ended."""
    with largest_file(1000), pytest.raises(OutputError, match="File too large"), atomic_write(tmp_path / "a") as part:
        part.write_bytes(bytes(1000))
        raise error
    with pytest.raises(type(error)) as same, atomic_write(tmp_path / "a") as part:
        part.write_bytes(bytes(1000))
        raise error  # the disk takes more: it was something else
    assert same.value is error and names(tmp_path) == []


def write_arrays(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, a=np.random.default_rng(0).integers(0, 255, 300_000, dtype=np.uint8))


def write_picture(path: Path) -> None:
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (300, 300, 3), dtype=np.uint8)).save(path, format="PNG")


def write_parameters(path: Path) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra vssm-gym[rl]")
    torch.save({"a": torch.zeros(300_000)}, path)


def write_video(path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")
    rng = np.random.default_rng(0)
    write_frames(path, (rng.integers(0, 255, (240, 320, 3), dtype=np.uint8) for _ in range(20)), 20)


@pytest.mark.parametrize("write", [write_arrays, write_picture, write_parameters, write_video])
def test_every_writer_of_a_library_ends_in_the_same_error(tmp_path: Path, write: Callable[[Path], None]) -> None:
    message = r"/file: could not be written: File too large$"
    with largest_file(100_000), pytest.raises(OutputError, match=message), atomic_write(tmp_path / "file") as temporary:
        write(temporary)
    assert names(tmp_path) == []
    with atomic_write(tmp_path / "file") as temporary:
        write(temporary)
    assert (tmp_path / "file").stat().st_size > 100_000


def test_a_file_that_cannot_be_read_is_not_one_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(PermissionError, match="secret") as same, atomic_write(tmp_path / "file"):
        raise PermissionError(errno.EACCES, "Permission denied", "/elsewhere/secret")
    assert not isinstance(same.value, OutputError)
