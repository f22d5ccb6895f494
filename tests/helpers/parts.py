"""Deal the test files to parts in turn, those with slow tests first, so that every part has some of them."""

from functools import cache
from pathlib import Path

SLOW = "mark.slow"


@cache
def files_in_turn(root: Path) -> list[str]:
    """Return the test files in the order in which parts take them, relative to ``root``."""
    files = sorted((root / "tests").rglob("test_*.py"))
    slow = {path: SLOW in path.read_text(encoding="utf-8") for path in files}
    return [path.relative_to(root).as_posix() for path in sorted(files, key=lambda path: not slow[path])]
