"""Test bounded reading of users' files: ordinary files of limited size, inside the folder they belong to."""

import os
from pathlib import Path

import pytest

from vssm_gym.errors import LONGEST_MESSAGE, LONGEST_VALUE, InputError
from vssm_gym.files.bounded import inside, open_file, read_bytes, read_text


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345" and read_text(path, 5) == "12345"
    with pytest.raises(InputError, match="at most 4 bytes"):
        read_bytes(path, 4)


@pytest.mark.parametrize(
    "make", [Path.mkdir, os.mkfifo, lambda path: None, lambda path: path.symlink_to("/dev/zero"), None]
)
def test_a_path_that_is_no_ordinary_file_is_refused_at_once(tmp_path: Path, make) -> None:
    path = tmp_path / "file" if make else "a\0b"
    if make:
        make(path)
    with pytest.raises(InputError, match="expected a map"):
        open_file(path, "a map")


def test_text_is_utf8(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="UTF-8"):
        read_text(tmp_path / "file", 10)


@pytest.mark.parametrize("name", ["../x", "a/../../x", "/etc/passwd", "", "a\0b", ".."])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="inside"):
        inside(tmp_path, name, "index", "line 1")


def test_names_inside_the_folder_are_joined(tmp_path: Path) -> None:
    assert inside(tmp_path, "rgb/1.png", "index", "line 1") == tmp_path / "rgb" / "1.png"


@pytest.mark.parametrize("value", ["x" * 5000, "\x1b[31m\n\r\u202e" * 100, "\ud800", "word " * 5000])
def test_an_error_is_one_line_that_quotes_little(value: str) -> None:
    error = InputError(value, value, value)
    assert str(error).isprintable() and max(map(len, str(error).split())) <= LONGEST_VALUE + 2
    assert len(str(error)) <= 3 * LONGEST_MESSAGE + 20
