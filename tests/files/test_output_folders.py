"""Output folders: one run at a time, nothing of another run is ever replaced, and a refusal leaves no trace."""

import os
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from vssm_gym.errors import InputError, OutputError
from vssm_gym.files.output_folders import (
    Owner,
    check_file,
    check_new_file,
    owned_folder,
    whole_folder,
)

DEAD = 2**22 + 1  # above the largest number that Linux gives a process
SWEEP = Owner("sweep", "sweep.json", {"config_hash": "aa"}, resumed=("rows",))
OTHER = Owner("sweep", "sweep.json", {"config_hash": "bb"}, resumed=("rows",))
SLAM = Owner("SLAM run", "slam.json", {"config_hash": "cc"}, finished="report")


def refused(entering: AbstractContextManager[object], match: str) -> None:
    with pytest.raises(InputError, match=match), entering:
        pass


def tree(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def swept(tmp_path: Path) -> Path:
    """Return a folder that SWEEP wrote to."""
    with owned_folder(tmp_path / "out", SWEEP):
        (tmp_path / "out" / "maps").mkdir()
        (tmp_path / "out" / "maps" / "oak").write_text("a map")
        (tmp_path / "out" / "rows").write_text("1\n")
    return tmp_path / "out"


def test_a_folder_has_one_writer_at_a_time(tmp_path: Path) -> None:
    with owned_folder(tmp_path / "out", SWEEP):
        assert (tmp_path / "out" / "sweep.json").is_file()
        refused(owned_folder(tmp_path / "out", SWEEP, resume=True), "no other run writing to it at the same time")
        refused(owned_folder(tmp_path / "out", SLAM), "no other run")
        assert (tmp_path / "out" / "sweep.json").is_file()
    with owned_folder(tmp_path / "out", SLAM):
        pass


def test_the_same_run_continues_with_resume_only(swept: Path) -> None:
    before = tree(swept)
    refused(owned_folder(swept, SWEEP), r"it holds rows \(--resume continues it")
    with owned_folder(swept, SWEEP, resume=True):
        assert {k: v for k, v in tree(swept).items() if k != ".lock"} == before
    assert tree(swept) == before


@pytest.mark.parametrize("resume", [True, False])
def test_no_other_run_gets_in(swept: Path, resume: bool) -> None:
    before = tree(swept)
    refused(
        owned_folder(swept, OTHER, resume), r"config_hash: expected bb.*found aa.*choose another folder, or delete it"
    )
    refused(owned_folder(swept, SLAM, resume), r"that of a SLAM run, which has a slam\.json; it holds maps")
    (swept / "sweep.json").write_text("[]")
    refused(owned_folder(swept, SWEEP, resume), "config_hash: expected aa")
    assert tree(swept) == before | {"sweep.json": "[]"}


def test_a_map_without_rows_is_another_runs_too(swept: Path) -> None:
    """A killed sweep that has recorded for minutes and run no episode."""
    (swept / "rows").unlink()
    refused(owned_folder(swept, OTHER), "another sweep belongs into another folder")
    with owned_folder(swept, SWEEP):
        assert (swept / "maps" / "oak").read_text() == "a map"


def test_other_files_are_no_runs_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    refused(owned_folder(tmp_path, SWEEP), r"a new or empty folder, .*it holds thesis\.tex")
    assert tree(tmp_path) == {"thesis.tex": "years of work"}
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    refused(owned_folder(tmp_path / "out", SWEEP), "folder")


def test_a_finished_run_is_never_repeated_an_unfinished_one_is(tmp_path: Path) -> None:
    with owned_folder(tmp_path, SLAM):
        (tmp_path / "map").write_text("a map")
    with owned_folder(tmp_path, SLAM):
        (tmp_path / "report").write_text("a page")
    refused(owned_folder(tmp_path, SLAM), "a finished run is never overwritten")


@pytest.mark.parametrize("error", [None, InputError("a", "b", "c"), KeyboardInterrupt()])
@pytest.mark.parametrize("exists", [True, False])
def test_a_run_that_writes_nothing_leaves_nothing(tmp_path: Path, error: BaseException | None, exists: bool) -> None:
    out = tmp_path / "out"
    if exists:
        out.mkdir()
    try:
        with owned_folder(out, SWEEP):
            (out / "rows").touch()  # a log without a line
            (out / "maps").mkdir()  # and a folder without a file
            (out / "rows").unlink()
            (out / "maps").rmdir()
            if error:
                raise error
    except (InputError, KeyboardInterrupt) as raised:
        assert raised is error
    assert out.exists() == exists and (not exists or list(out.iterdir()) == [])


def test_what_a_kill_left_before_the_first_result_stops_nobody(tmp_path: Path) -> None:
    for name in ("sweep.json", ".lock", f".oak.{DEAD}.tmp"):
        (tmp_path / name).write_text("{}")
    (tmp_path / "rows").touch()
    (tmp_path / "recordings" / f".oak.{DEAD}.tmp").mkdir(parents=True)
    (tmp_path / "recordings" / f".oak.{DEAD}.tmp" / "rgb.txt").write_text("half")
    with owned_folder(tmp_path, OTHER):
        (tmp_path / "rows").write_text("1\n")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["recordings", "rows", "sweep.json"]


def test_a_link_is_something_and_is_left_alone(tmp_path: Path) -> None:
    """A folder that holds nothing but a link is not empty: what it leads to may be anything."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "maps").symlink_to(tmp_path / "elsewhere")
    refused(owned_folder(tmp_path / "out", SWEEP), "it holds maps")
    assert (tmp_path / "out" / "maps").is_symlink()


def test_a_whole_folder_has_one_writer_and_is_never_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "new" / "drive"
    with whole_folder(out) as unfinished:
        (unfinished / "rgb.txt").write_text("frames")
        assert not out.exists()
        refused(whole_folder(out), "no other run")
    assert tree(tmp_path) == {"new/drive/rgb.txt": "frames"}
    refused(whole_folder(out), r"nothing is ever overwritten; it holds rgb\.txt")
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / "other") as unfinished:
        (unfinished / "rgb.txt").write_text("half")
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == ["new"]


def test_the_next_whole_folder_removes_what_a_kill_left(tmp_path: Path) -> None:
    (tmp_path / f".drive.{DEAD}.tmp").mkdir()
    (tmp_path / f".drive.{DEAD}.tmp" / "rgb.txt").write_text("half")
    (tmp_path / ".drive.lock").touch()
    with whole_folder(tmp_path / "drive") as unfinished:
        (unfinished / "rgb.txt").write_text("frames")
    assert tree(tmp_path) == {"drive/rgb.txt": "frames"}


def test_a_file_replaces_neither_an_input_nor_another_kind(tmp_path: Path) -> None:
    walk, page = tmp_path / "walk.json", tmp_path / "page.html"
    walk.write_text("poses")
    (tmp_path / "link.json").symlink_to(walk)
    for path in (walk, tmp_path / "link.json"):
        with pytest.raises(InputError, match=r"another file than the input .*walk\.json"):
            check_file(path, (".json",), inputs=(tmp_path / "none", walk))
    with pytest.raises(InputError, match=r"a name that ends in \.html or \.htm"):
        check_file(walk, (".html", ".htm"))
    page.write_text("an older page")
    check_file(page, (".html",), inputs=(walk,))
    check_new_file(tmp_path / "map.npz", (".npz",))
    for path in (page, tmp_path / "link.json"):
        with pytest.raises(InputError, match="a new file: this one is never overwritten"):
            check_new_file(path)
    assert walk.read_text() == "poses"


@pytest.mark.parametrize("name", ["sweep.json", ".lock"])
@pytest.mark.parametrize("kind", ["link", "folder"])
def test_a_manifest_or_lock_that_is_no_file_is_refused(tmp_path: Path, name: str, kind: str) -> None:
    """The file that a link leads to is never overwritten."""
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    out.mkdir()
    elsewhere.write_text("precious")
    (out / name).symlink_to(elsewhere) if kind == "link" else (out / name).mkdir()
    with pytest.raises(InputError, match="file: expected an ordinary file"), owned_folder(out, SWEEP):
        pass
    assert elsewhere.read_text() == "precious"


@pytest.mark.parametrize("name", [".lock", f".oak.{DEAD}.tmp", "empty"])
def test_what_would_stop_a_whole_folder_in_the_end_is_refused_at_once(tmp_path: Path, name: str) -> None:
    out = tmp_path / "drive"
    out.mkdir()
    (out / name).touch()
    with pytest.raises(InputError, match="folder: expected a new or empty folder"), whole_folder(out):
        raise AssertionError("hours of work")
    assert (out / name).exists()


def test_a_name_that_is_too_long_is_refused(tmp_path: Path) -> None:
    for context in (owned_folder(tmp_path / ("x" * 300), SWEEP), whole_folder(tmp_path / ("x" * 300))):
        with pytest.raises(InputError, match="folder: expected the name of a folder"), context:
            pass


@pytest.mark.skipif(sys.platform != "linux", reason="has no /proc")
def test_a_folder_that_takes_no_entries_is_an_error_of_its_own(tmp_path: Path) -> None:
    unmakeable = Path("/proc/x")  # root may write to /proc, says access; the kernel has no such file
    for context in (owned_folder(unmakeable, SWEEP), whole_folder(unmakeable), owned_folder(unmakeable / "y", SWEEP)):
        with pytest.raises((InputError, OutputError), match=r"/proc"), context:
            pass
