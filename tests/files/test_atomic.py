"""Test atomic writes: at every moment the old file or the complete new one exists, and no other remains."""

import os
from pathlib import Path

import pytest

from vssm_gym.files.atomic import atomic_write


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
