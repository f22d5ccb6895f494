"""Define a metric: a function of an episode's row, and how its values are shown and compared."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.row import RENAMED_FIELDS

Row = Mapping[str, Any]
Value: TypeAlias = float | bool | None
Direction: TypeAlias = Literal["higher", "lower", "neither"]


@dataclass(frozen=True)
class Metric:
    """Define a number of an episode.

    Attributes:
        function: row -> value; None where the row does not say.
        label: heading of its column.
        digits: after the point.
        direction: which values are better.
        reports: the kinds of report whose tables show it: ``navigation``, ``car``, ``explore``.
        headline: those of them that open with it.
        compared: those of them that show its paired differences.
        proportion: whether it is a boolean, shown in % with the interval of a proportion.
        score: whether it lies in [0, 1] and reports show its interquartile mean and its profile as well.
        within: the least and the largest value that it can have, for intervals over few tasks; None: not known, or
            [0, 1] by ``proportion`` or ``score``.
    """

    function: Callable[[Row], Value]
    label: str
    digits: int
    direction: Direction
    reports: tuple[str, ...]
    headline: tuple[str, ...] = ()
    compared: tuple[str, ...] = ()
    proportion: bool = False
    score: bool = False
    within: tuple[float, float] | None = None


def stored(field: str, factor: float = 1.0) -> Callable[[Row], Value]:
    """Return a function that reads ``field`` of a row and multiplies it by ``factor``; a boolean stays as it is."""

    def read(row: Row) -> Value:
        value = row.get(field)
        return value if value is None or isinstance(value, bool) else factor * value

    return read


def check_name(name: str) -> str:
    """Return a metric's name; raise :class:`InputError` with the present name for one that has been renamed."""
    if name in RENAMED_FIELDS:
        raise InputError("metrics", name, f"{RENAMED_FIELDS[name]!r}, as this metric is called now")
    return name
