"""What a metric is: a function of an episode's row, and how its values are shown and compared."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

Row = Mapping[str, Any]
Value: TypeAlias = float | bool | None
Direction: TypeAlias = Literal["higher", "lower", "neither"]


@dataclass(frozen=True)
class Metric:
    """A number of an episode.

    Attributes:
        function: row -> value; None where the row does not say.
        label: heading of its column.
        digits: after the point.
        direction: which values are better.
        reports: the kinds of report whose tables show it: ``navigation``, ``car``, ``explore``.
        headline: those of them that open with it.
        compared: those of them that show its paired differences.
        share: a boolean, shown in % with the interval of a share.
    """

    function: Callable[[Row], Value]
    label: str
    digits: int
    direction: Direction
    reports: tuple[str, ...]
    headline: tuple[str, ...] = ()
    compared: tuple[str, ...] = ()
    share: bool = False


def stored(field: str, factor: float = 1.0) -> Callable[[Row], Value]:
    """The value that the row holds in ``field``, times ``factor``; a boolean as it is."""

    def read(row: Row) -> Value:
        value = row.get(field)
        return value if value is None or isinstance(value, bool) else factor * value

    return read
