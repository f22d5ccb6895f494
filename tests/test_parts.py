"""Test the parts of the test suite: together they are all of it, and no file is in two."""

import re
import subprocess
import sys

import pytest

from tests.helpers.parts import SLOW, files_in_turn
from tests.helpers.paths import CHECKOUT

SOME = ["tests/geometry", "tests/files", "tests/viz"]  # folders: a file that is named is always read


def collected(*words: str) -> list[str]:
    """Return the files that pytest collects, one for each."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", *SOME, *words]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 5), done.stderr  # 5: this part has none of the files
    return [line.split(":")[0] for line in done.stdout.splitlines() if line.startswith("tests/")]


@pytest.mark.slow
def test_the_parts_are_the_whole_suite_and_no_file_is_in_two():
    parts = [collected("--part", f"{k}/3") for k in (1, 2, 3)]
    together = [file for part in parts for file in part]
    assert sorted(together) == sorted(collected())
    assert max(map(len, parts)) < len(together)


@pytest.mark.slow
@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "one/three"])
def test_a_part_that_is_none_is_refused(text):
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "--part", text, "tests/test_api.py"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "argument --part: expected K/N with 1 <= K <= N" in done.stderr


def test_every_part_that_ci_may_choose_has_slow_tests():
    """A part without any would end with an error, whatever the commit holds."""
    chosen = re.search(r"% (\d+) \+ 1\)\)/(\d+)", (CHECKOUT / ".ci" / "run").read_text())
    assert chosen and chosen[1] == chosen[2]
    first = files_in_turn(CHECKOUT)[: int(chosen[1])]
    assert len(first) == int(chosen[1])
    assert all(SLOW in (CHECKOUT / name).read_text() for name in first)
