"""Parse arguments that are written as one word: sizes and lists of numbers."""

import re
from collections.abc import Callable
from typing import TypeVar

from vssm_gym.errors import InputError

Number = TypeVar("Number", int, float)


def parse_size(command: str, text: str) -> tuple[int, int]:
    """Return the width and height of ``WIDTHxHEIGHT``, pixels.

    Raises:
        InputError: another form; it names the command.
    """
    if not (match := re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text.strip())):
        raise InputError(command, "size", f"WIDTHxHEIGHT in pixels, as 160x120, not {text!r}")
    return int(match[1]), int(match[2])


def parse_numbers(command: str, field: str, text: str, kind: Callable[[str], Number], form: str) -> tuple[Number, ...]:
    """Return the numbers of a list with commas between them, in their order.

    Args:
        command: that takes the argument.
        field: name of the argument.
        text: as it was typed.
        kind: ``int`` or ``float``.
        form: what the list should look like, for the error message.

    Raises:
        InputError: a part of the list is no number.
    """
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError:
        raise InputError(command, field, f"{form}, not {text!r}") from None
