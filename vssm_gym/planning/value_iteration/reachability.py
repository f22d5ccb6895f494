"""Find the poses with a path to the goal, ``{s : W(s) > 0}``, backwards from the goal (eq. P20).

States without a path would approach their value ``1 / (1 - gamma)`` by a factor ``gamma`` per sweep wherever the sweeps
start too low, as a warm start does behind a door that closed. Known beforehand, they start at their final value.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def flood(
    goal: np.ndarray, allowed: np.ndarray, steps: np.ndarray, offsets: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Return the states from which motions lead to the goal with a positive weight at each step.

    A motion leads to a state if that is any of the corners, of positive weight, between which its successor lies.

    Args:
        goal: ``(headings, interior)`` bool, flat planes as in :mod:`~vssm_gym.planning.value_iteration.sweeps`.
        allowed: ``(headings, interior)`` int32, bit a set where motion a may be driven; 0 in the padding.
        steps: ``(motions,)`` turn in steps of the heading grid.
        offsets: ``(headings, motions, 4)`` from a cell to the corners of its successor, in its flat plane.
        used: ``(headings, motions, 4)`` bool, corners of positive weight.

    Returns:
        ``(headings, interior)`` bool.
    """
    n, size = goal.shape
    found = goal.copy()
    stack = np.empty(n * size, np.int64)
    top = 0
    for state in np.flatnonzero(goal):
        stack[top] = state
        top += 1
    while top > 0:
        top -= 1
        after = stack[top] // size
        cell = stack[top] - after * size
        for a in range(len(steps)):
            h = (after - steps[a]) % n
            for c in range(4):
                before = cell - offsets[h, a, c]
                # Most states have been found: asked first, that spares the other two.
                if 0 <= before < size and not found[h, before] and allowed[h, before] >> a & 1 and used[h, a, c]:
                    found[h, before] = True
                    stack[top] = h * size + before
                    top += 1
    return found
