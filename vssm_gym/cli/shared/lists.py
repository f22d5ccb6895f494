"""Read lists of arguments, and line up the columns of a table."""

from collections.abc import Callable, Sequence
from typing import TypeVar

Number = TypeVar("Number", int, float)


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with columns of one width, the first to the left and the others to the right."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return [
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))])
        for line in lines
    ]


def distinct(field: str, text: str, kind: Callable[[str], Number]) -> tuple[Number, ...]:
    """Return the numbers of a list with commas between them, each once, in their order."""
    from vssm_gym.cli.shared.arguments import parse_numbers

    return tuple(dict.fromkeys(parse_numbers("study", field, text, kind, "numbers with commas between")))


def names_in(text: str) -> tuple[str, ...]:
    """Return the names of a list with commas between them, each once, in their order."""
    return tuple(dict.fromkeys(text.replace(" ", "").split(",")))
