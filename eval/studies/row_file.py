"""Read the rows of a study that is continued where it stopped: a file of lines, each a JSON object of one model."""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vssm_gym.envs.validation import StrictModel
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import read_bytes

MOST_ROW_BYTES = 1 << 20  # of a line that is read again
MOST_FILE_BYTES = 256 << 20  # of all of them


def read_rows(path: Path, kind: type[StrictModel]) -> list[dict[str, Any]]:
    """Return the rows of a file; none where there is no file; an unfinished last line is left out.

    Raises:
        InputError: a line that is no row of this kind.
    """
    if not path.is_file():
        return []
    rows: list[dict[str, Any]] = []
    lines = read_bytes(path, MOST_FILE_BYTES, "runs of this study").splitlines(keepends=True)
    for number, line in enumerate(lines, start=1):
        if not line.endswith(b"\n"):
            break
        try:
            row = kind.model_validate_json(line if len(line) <= MOST_ROW_BYTES else b"")
        except ValidationError:
            raise InputError(path, f"line {number}", "a run of this study") from None
        rows.append(row.model_dump())
    return rows
