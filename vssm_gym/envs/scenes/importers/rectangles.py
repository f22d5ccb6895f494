"""Cover cells by few rectangles, which become the walls and boxes of maps and voxels."""

import numpy as np
from jaxtyping import Bool

Rectangle = tuple[int, int, int, int]  # i0, i1, j0, j1 of cells, half open


def cover(
    needed: Bool[np.ndarray, "n m"], allowed: Bool[np.ndarray, "n m"], most: int | None = None
) -> list[Rectangle]:
    """Return disjoint rectangles that contain every ``needed`` cell and no cell that is not ``allowed``.

    Greedy: the first needed cell left grows into the longest run either way, then into the widest block of such runs;
    of the two blocks the one that covers more wins. ``needed`` implies ``allowed``. Where more than ``most`` rectangles
    would be needed, the first ``most + 1`` are returned, which the caller refuses.
    """
    left, allowed = needed.copy(), allowed.copy()
    rectangles: list[Rectangle] = []
    for i in range(len(left)):
        j = int(np.argmax(left[i])) if left.shape[1] else 0
        while j < left.shape[1] and left[i, j]:
            rows, columns = _grow(allowed, i, j), _grow(allowed.T, j, i)
            choices = [rows, (columns[2], columns[3], columns[0], columns[1])]
            best = max(choices, key=lambda r: np.count_nonzero(left[r[0] : r[1], r[2] : r[3]]))
            left[best[0] : best[1], best[2] : best[3]] = False
            allowed[best[0] : best[1], best[2] : best[3]] = False
            rectangles.append(best)
            if most is not None and len(rectangles) > most:
                return rectangles
            j += int(np.argmax(left[i, j:]))
    return rectangles


def _grow(allowed: np.ndarray, i: int, j: int) -> Rectangle:
    """Return the longest allowed run of row ``i`` through column ``j``, with the neighbours that allow all of it."""
    j0, j1 = j - _run(allowed[i, :j][::-1]), j + _run(allowed[i, j:])
    block = allowed[:, j0:j1]
    return i - _rows(block[:i][::-1]), i + _rows(block[i:]), j0, j1


def _run(cells: np.ndarray) -> int:
    """Return how many cells from the first on are set."""
    return len(cells) if cells.all() else int(np.argmin(cells))


def _rows(block: np.ndarray) -> int:
    """Return how many rows from the first on are set all along, examined in portions that double."""
    found, portion = 0, 4
    while found < len(block):
        full = np.asarray(block[found : found + portion].all(axis=1))
        if not full.all():
            return found + int(np.argmin(full))
        found, portion = found + len(full), 2 * portion
    return found
