"""Compare a row with the row that an earlier run wrote: the first field whose value differs.

Numbers agree if ``|a - b| <= tolerance max(1, |a|)``; everything else must be equal. What says when and by what a row
was made, and how long that took, is not an outcome.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MADE_BY = ("format", "version", "processor", "config_hash", "map_hash", "explored")  # of code, machine, sweep and files
TIMES = ("latency", "decision_p50", "decision_p95")
PICTURED = ("trace",)  # thinned paths for a picture; their metrics are compared
NOT_OUTCOMES = frozenset(MADE_BY + TIMES + PICTURED)  # fields that are not compared


@dataclass(frozen=True)
class Reproduced:
    """Hold one row that was run again.

    Attributes:
        name: of the row in words.
        difference: the first field that differs; None if the outcomes agree.
        version: of the package that wrote the earlier row; None where it does not say so.
        processor: of the machine that did; None where the row does not say so.
    """

    name: str
    difference: str | None
    version: str | None = None
    processor: str | None = None

    @property
    def made_by(self) -> str:
        """Return version and processor in words; empty where neither is known."""
        return " on ".join(part for part in (self.version, self.processor) if part)


def spread_evenly(rows: Sequence[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Return at most so many rows, from the first to the last."""
    places = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    return [rows[k] for k in np.unique(places)]


def first_difference(expected: Mapping[str, Any], found: Mapping[str, Any], tolerance: float) -> str | None:
    """Return the first field that differs, with both values; None if the outcomes agree.

    Args:
        expected: the earlier row; fields that came later it does not have, and they are not compared.
        found: the row of the same episode now.
        tolerance: of numbers, absolute below 1 and relative above.
    """
    for name, value in expected.items():
        if name in NOT_OUTCOMES:
            continue
        if name not in found:
            return f"{name}: expected {value!r:.80}; now it is not there"
        if where := _difference(value, found[name], tolerance):
            path, old, new = where
            return f"{name}{path}: expected {old!r:.80}, now {new!r:.80}"
    return None


def _difference(old: Any, new: Any, tolerance: float) -> tuple[str, Any, Any] | None:
    """Return where two values differ, as a path with both; None if they agree."""
    numbers = [isinstance(value, int | float) and not isinstance(value, bool) for value in (old, new)]
    if all(numbers):
        same = old == new or math.isclose(old, new, rel_tol=tolerance, abs_tol=tolerance)
        return None if same else ("", old, new)
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        keys = list(dict.fromkeys([*old, *new]))
        pairs = [(f".{key}", old.get(key), new.get(key)) for key in keys]
    elif _is_list(old) and _is_list(new) and len(old) == len(new):
        pairs = [(f"[{k}]", a, b) for k, (a, b) in enumerate(zip(old, new, strict=True))]
    else:
        same = old == new and isinstance(old, bool) == isinstance(new, bool)
        return None if same else ("", old, new)
    for key, a, b in pairs:
        if where := _difference(a, b, tolerance):
            return f"{key}{where[0]}", *where[1:]
    return None


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)
