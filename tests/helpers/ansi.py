"""Decode half-block pictures as a terminal displays them, independently of the code that wrote them."""

import re

import numpy as np

_LEVELS = (0, 95, 135, 175, 215, 255)


def pixels(lines: list[str]) -> np.ndarray:
    """Return the picture ``(2 lines, columns, 3)`` uint8 of lines of ``▀`` and spaces; nothing else may occur."""
    rows = []
    for line in lines:
        front = back = (0, 0, 0)
        upper, lower = [], []
        for escape, character in re.findall(r"\x1b\[([\d;]*)m|(.)", line):
            if not character:
                codes = [int(code or 0) for code in escape.split(";")]
                while codes:
                    kind = codes.pop(0)
                    if kind == 0:
                        front = back = (0, 0, 0)
                        continue
                    assert kind in (38, 48)
                    if codes.pop(0) == 2:
                        colour = (codes.pop(0), codes.pop(0), codes.pop(0))
                    else:
                        cube = codes.pop(0) - 16
                        assert 0 <= cube < 216
                        colour = (_LEVELS[cube // 36], _LEVELS[cube // 6 % 6], _LEVELS[cube % 6])
                    front, back = (colour, back) if kind == 38 else (front, colour)
                continue
            assert character in "▀ "
            upper.append(front if character == "▀" else back)
            lower.append(back)
        rows += [upper, lower]
    return np.array(rows, np.uint8)
