"""Read JSON and lines of JSON within bounds of size, nesting and numbers."""

import gzip
import io
import json
import math
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError
from vssm_gym.files.bounded import open_file, read_bytes

JSON_BYTES = 16 << 20  # as Python objects up to 30 times as much; the largest ProcTHOR house has 0.1 MB
LINES_BYTES = 512 << 20  # unpacked, up to the line that is asked for; all 10,000 ProcTHOR houses of a split have 0.4 GB
LINES = 1_000_000  # of a JSONL file, up to the line that is asked for
ROWS = 500_000  # of a JSONL file that is read whole; a log of 200,000 episodes is the largest
JSON_DEPTH = 100  # nested lists and objects; the formats read here nest 12 deep at most
LARGEST_WHOLE = 2**63  # a larger whole number fits no array


def read_json(path: str | Path, limit: int = JSON_BYTES, expected: str = "a readable JSON file") -> Any:
    """Return the parsed JSON of a file of at most ``limit`` bytes."""
    return parse_json(read_bytes(path, limit, expected), path)


def read_packed_json(path: str | Path, limit: int, expected: str = "a readable JSON file") -> Any:
    """Return the parsed JSON of a file, packed by gzip if named ``.gz``, of at most ``limit`` bytes when unpacked."""
    if Path(path).suffix != ".gz":
        return read_json(path, limit, expected)
    try:
        with open_file(path, expected) as stored, gzip.open(stored, "rb") as file:
            content = file.read(limit + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(path, "file", f"{expected}, packed by gzip ({error})") from error
    if len(content) > limit:
        raise InputError(path, "file", f"at most {limit:,} bytes when unpacked")
    return parse_json(content, path)


def read_json_line(path: Path, line: int) -> Any:
    """Return the parsed JSON on line ``line``, counted from 0, of a JSONL file (packed if named ``.gz``)."""
    source = f"{path}#{line}"
    if line > LINES:
        raise InputError(source, "line", f"a number below {LINES:,}")
    unpacked = 0
    try:
        with open_file(path) as stored, gzip.open(stored, "rb") if path.suffix == ".gz" else stored as file:
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


def parse_json_lines(content: bytes, source: object, what: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield number, counted from 1, and object of each line; ``what`` a line holds is named in errors."""
    if content.count(b"\n") > ROWS:
        raise InputError(source, "lines", f"at most {ROWS:,} of them")
    for number, line in enumerate(io.BytesIO(content), start=1):
        try:
            value = parse_json(line, source)
        except InputError as error:
            raise InputError(source, f"line {number}", f"{what} as JSON ({error.expected})") from error
        if not isinstance(value, dict):
            raise InputError(source, f"line {number}", f"{what} as a JSON object; found {value!r:.80}")
        yield number, value


def parse_json(content: bytes, source: object, field: str = "content") -> Any:
    """Return plain data of JSON text in UTF-8: finite numbers, nested at most ``JSON_DEPTH`` deep.

    Raises:
        InputError: naming ``source`` and ``field``, or the line of a syntax error.
    """

    def refuse(constant: str) -> None:
        raise InputError(source, field, f"finite numbers; found {constant}")

    def finite(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            refuse(digits[:40])
        return value

    def whole(digits: str) -> int:
        if len(digits.lstrip("-")) > len(str(LARGEST_WHOLE)) or abs(int(digits)) >= LARGEST_WHOLE:
            raise InputError(source, field, f"whole numbers below 2^63; found {digits:.40}")
        return int(digits)

    deep = InputError(source, field, f"JSON nested at most {JSON_DEPTH} deep")
    try:
        data = json.loads(content.decode("utf-8"), parse_constant=refuse, parse_float=finite, parse_int=whole)
    except UnicodeDecodeError as error:
        raise InputError(source, field, "UTF-8 text") from error
    except json.JSONDecodeError as error:
        raise InputError(source, f"line {error.lineno}", f"valid JSON ({error.msg})") from error
    except RecursionError as error:
        raise deep from error
    level = [data]
    for _ in range(JSON_DEPTH):  # one level of nesting after the other
        level = [inner for outer in level for inner in _children(outer)]
    if any(isinstance(inner, dict | list) for inner in level):
        raise deep
    return data


def _children(value: Any) -> Iterable[Any]:
    """Return what a list or an object holds; nothing of a number or a text."""
    return value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
