"""Read users' files within bounds of size, nesting and unpacking; the first error becomes one `InputError`."""

import gzip
import json
import zlib
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError

JSON_BYTES = 64 << 20  # of a JSON file; the largest ProcTHOR house has 0.1 MB, the asset database 1.5 MB
LINES_BYTES = 512 << 20  # unpacked, up to the line that is asked for; all 10,000 ProcTHOR houses of a split have 0.4 GB


def read_bytes(path: Path, limit: int) -> bytes:
    """Return the file's content; raise InputError where it cannot be read or has more than ``limit`` bytes."""
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except OSError as error:
        raise InputError(path, "file", f"a readable file ({error.strerror})") from error
    if len(content) > limit:
        raise InputError(path, "file", f"at most {limit:,} bytes")
    return content


def read_json(path: Path) -> Any:
    """Return the parsed JSON of a file."""
    return parse_json(read_bytes(path, JSON_BYTES), path)


def read_json_line(path: Path, line: int) -> Any:
    """Return the parsed JSON on line ``line``, counted from 0, of a JSONL file (packed if named ``.gz``)."""
    source = f"{path}#{line}"
    unpacked = 0
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as file:
            for number in range(line + 1):
                content = file.readline(JSON_BYTES + 1)
                unpacked += len(content)
                if not content.strip():
                    raise InputError(source, "line", f"a number below {number}, the lines of the file, counted from 0")
                if len(content) > JSON_BYTES or unpacked > LINES_BYTES:
                    raise InputError(source, "file", f"lines of at most {JSON_BYTES:,} bytes, {LINES_BYTES:,} in all")
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(path, "file", f"a readable file of JSON lines ({error})") from error
    return parse_json(content, source)


def parse_json(content: bytes, source: object) -> Any:
    """Return plain data of JSON text in UTF-8 without NaN and infinities."""

    def refuse(constant: str) -> None:
        raise InputError(source, "scene", f"finite numbers; found {constant}")

    try:
        return json.loads(content.decode("utf-8"), parse_constant=refuse)
    except UnicodeDecodeError as error:
        raise InputError(source, "scene", "UTF-8 text") from error
    except RecursionError as error:
        raise InputError(source, "scene", "JSON nested less deeply") from error
    except json.JSONDecodeError as error:
        raise InputError(source, f"line {error.lineno}", f"valid JSON ({error.msg})") from error
    except InputError:
        raise
    except ValueError as error:  # whole numbers of thousands of digits
        raise InputError(source, "scene", "numbers of fewer digits") from error
