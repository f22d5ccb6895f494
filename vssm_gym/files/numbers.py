"""Check the numbers of users' files in one place: real, finite, of the stated shape, small enough for float32."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.bounded import check_lines, read_bytes

LARGEST_NUMBER = 1e12  # no length, angle, time, focal length or coefficient is larger; its square still fits float32
TABLE_BYTES = 400_000_000  # of a table of numbers as text: an hour of IMU readings at 1 kHz
TABLE_LINES = 4_000_000  # that hour has 3.6 million
TABLE_NUMBERS = 30_000_000  # of a table, as float64 240 MB; that hour has 25 million


def floats(
    value: Any,
    shape: tuple[int, ...],
    source: object,
    field: str,
    *,
    largest: float = LARGEST_NUMBER,
    positive: bool = False,
) -> np.ndarray:
    """Return nested lists of numbers as float64 of ``shape``.

    Args:
        value: a number, or lists of them; neither texts nor truth values count as numbers.
        shape: the expected one; a value with as many numbers in one flat list is accepted.
        source: the file or argument, for errors.
        field: its name within ``source``.
        largest: bound of the absolute value.
        positive: zero and negative numbers are refused.

    Raises:
        InputError: anything else.
    """
    expected = f"{'positive ' if positive else ''}numbers of at most {largest:g}"
    expected = f"{expected}, {' x '.join(map(str, shape))} of them" if shape else f"one of the {expected}"
    numbers = _flat(value, 4)
    wanted = int(np.prod(shape))
    if numbers is None or len(numbers) != wanted or not all(abs(number) <= largest for number in numbers):
        raise InputError(source, field, f"{expected}; found {value!r:.100}")
    if positive and min(numbers, default=1.0) <= 0.0:
        raise InputError(source, field, f"{expected}; found {value!r:.100}")
    return np.array(numbers, dtype=float).reshape(shape)


def whole(value: Any, source: object, field: str, *, least: int, most: int) -> int:
    """Return a whole number between ``least`` and ``most``; raise InputError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InputError(source, field, f"a whole number from {least:,} to {most:,}; found {value!r:.100}")
    return value


def as_float32(array: np.ndarray, source: object, field: str, *, positive: bool = False) -> np.ndarray:
    """Return the array as float32, checked after the cast: what overflows is infinite, what underflows is zero."""
    kind = "positive finite" if positive else "finite"
    if array.dtype.kind != "f":
        raise InputError(source, field, f"floats; found {array.dtype}")
    with np.errstate(over="ignore"):
        cast = array.astype(np.float32, copy=False)
    low, high = (cast.min(), cast.max()) if cast.size else (np.float32(1.0), np.float32(1.0))  # NaN if one of them is
    if not (np.isfinite(low) and np.isfinite(high)) or (positive and low <= 0.0):
        raise InputError(source, field, f"{kind} numbers of 32 bits")
    return cast


def read_table(path: Path, expected: str, *, columns: int | None = None, limit: int = TABLE_BYTES) -> np.ndarray:
    """Read lines of numbers separated by spaces, ``#`` before a comment.

    Args:
        path: the file.
        expected: what a line holds, for errors.
        columns: of every line; None: as many as the first line has.
        limit: bytes.

    Returns:
        ``(lines, columns)`` float64, finite.

    Raises:
        InputError: the file is missing or too large, or a line is not as expected.
    """
    content = read_bytes(path, limit, expected)
    check_lines(content, TABLE_LINES, path)
    first = next((line for line in io.BytesIO(content) if line.split(b"#")[0].strip()), None)
    if first is None:
        return np.zeros((0, columns or 1))
    numbers = len(first.split(b"#")[0].split()) * (content.count(b"\n") + 1)
    if numbers > TABLE_NUMBERS:
        raise InputError(path, "lines", f"{expected}: at most {TABLE_NUMBERS:,} numbers; it has up to {numbers:,}")
    try:
        table = np.loadtxt(io.BytesIO(content), ndmin=2, encoding="utf-8")
    except ValueError as error:
        raise InputError(path, "lines", f"{expected}: numbers only ({error})") from error
    if columns is not None and table.size and table.shape[1] != columns:
        raise InputError(path, "lines", f"{expected}: {columns} numbers; found {table.shape[1]}")
    if table.size and not (table.min() >= -LARGEST_NUMBER and table.max() <= LARGEST_NUMBER):  # false for NaN
        row = int(np.argwhere(~(np.abs(table) <= LARGEST_NUMBER))[0, 0])
        raise InputError(path, "lines", f"{expected}: finite numbers; row {row} of the table has another")
    return table.reshape(-1, columns) if columns is not None else table


def _flat(value: Any, depth: int) -> list[float] | None:
    """Return the numbers of nested lists in order; None where something else is among them."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return [value]
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.dtype.kind in "iuf" else None
    if not isinstance(value, list | tuple) or depth == 0:
        return None
    numbers: list[float] = []
    for inner in value:
        flat = _flat(inner, depth - 1)
        if flat is None:
            return None
        numbers += flat
    return numbers
