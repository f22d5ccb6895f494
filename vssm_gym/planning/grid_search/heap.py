"""Keep the open nodes of a compiled search in a binary heap with the least ``key`` on top.

The caller owns the arrays. ``heap[:size]`` holds node numbers, and ``place[node]`` the position of a node in it, so
that a key can be lowered in place; -1 marks a node that was never open, -2 one that is closed.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def sift_up(heap: np.ndarray, place: np.ndarray, key: np.ndarray, k: int) -> None:
    """Move the node at position ``k``, whose key is new or lower than before, up to where it belongs."""
    node = heap[k]
    while k > 0:
        parent = (k - 1) >> 1
        if key[heap[parent]] <= key[node]:
            break
        heap[k] = heap[parent]
        place[heap[k]] = k
        k = parent
    heap[k] = node
    place[node] = k


@njit(cache=True, nogil=True)
def pop(heap: np.ndarray, place: np.ndarray, key: np.ndarray, size: int) -> int:
    """Remove and return the least node of a heap of ``size``; the caller counts one less and marks its ``place``."""
    top, node = heap[0], heap[size - 1]
    size -= 1
    k = 0
    while True:
        child = 2 * k + 1
        if child >= size:
            break
        if child + 1 < size and key[heap[child + 1]] < key[heap[child]]:
            child += 1
        if key[heap[child]] >= key[node]:
            break
        heap[k] = heap[child]
        place[heap[k]] = k
        k = child
    heap[k] = node
    place[node] = k
    return top
