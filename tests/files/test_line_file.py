"""Line files: a line is there whole or not at all, and a full disk takes none of those before."""

from pathlib import Path

import pytest

from tests.chaos.disks import largest_file
from vssm_gym.errors import OutputError
from vssm_gym.files.line_file import LineFile


def test_a_line_that_does_not_fit_is_taken_back_and_later_ones_fit_again(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    with LineFile(path) as file:
        file.append(b"one\n", sync=True)
        with largest_file(10), pytest.raises(OutputError, match="lines: could not be written: File too large"):
            file.append(b"a line that is too long\n")
        assert path.read_bytes() == b"one\n"
        file.append(b"two\n")
    assert path.read_bytes() == b"one\ntwo\n"


@pytest.mark.parametrize(("keep", "left"), [(None, b"one\ntw"), (4, b"one\n"), (0, b"")])
def test_it_continues_after_the_bytes_that_are_kept(tmp_path: Path, keep: int | None, left: bytes) -> None:
    path = tmp_path / "lines"
    path.write_bytes(b"one\ntw")
    with LineFile(path, keep) as file:
        assert path.read_bytes() == left
        file.append(b"two\n")
        file.truncate(len(left))
        file.append(b"three\n")
    assert path.read_bytes() == left + b"three\n"
