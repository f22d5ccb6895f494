"""Run pytest in a copy of the checkout, and make sure that the copy is what the tests import.

    python run_tests.py COPY [PYTEST ARGUMENTS]

The exit code is pytest's, and FOREIGN where the package came from somewhere else.
"""

import os
import sys
from pathlib import Path

import pytest

FOREIGN = 70  # exit code that pytest does not use


class CopyGuard:
    """Stop the run unless the package lies in the copy, links followed."""

    def __init__(self, copy: Path) -> None:
        self._copy = copy

    def pytest_collection_finish(self) -> None:
        """Look where the package was imported from, once the tests have imported it."""
        import vssm_gym

        home = Path(str(vssm_gym.__file__)).resolve()
        if not home.is_relative_to(self._copy):
            pytest.exit(f"vssm_gym is imported from {home.parent}, not from {self._copy}", returncode=FOREIGN)


def main(copy: str, *arguments: str) -> int:
    """Run the tests that the arguments name, relative to the copy; return pytest's exit code."""
    root = Path(copy).resolve()
    os.chdir(root)
    sys.path[0] = str(root)  # was this script's folder
    return int(pytest.main(list(arguments), plugins=[CopyGuard(root)]))


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
