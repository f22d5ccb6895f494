"""Order the visits to places by minimum latency: ``min over orders of sum_i w_i l_i`` (eq. P42).

``l_i`` is the path length until place i is reached and ``w_i`` what is gained there: the minimum-latency problem, or
travelling repairman problem. Summed by legs it is ``sum_legs |leg| * (weight not yet gained)``. With one place at a
time it is the greedy choice by gain per metre. The whole order also counts that a place that is left behind has to be
returned to. It is solved exactly by dynamic programming over subsets (Held and Karp), 2^n n^2 steps.
"""

import numpy as np
from numba import njit

MOST_PLACES = 12  # places at most: 2^12 12^2 = 0.6 million steps, a few milliseconds


@njit(cache=True, nogil=True)
def _solve(start, between, weight):
    n = weight.shape[0]
    full = 1 << n
    left = np.empty(full)
    for mask in range(full):
        left[mask] = 0.0
        for i in range(n):
            if not (mask >> i) & 1:
                left[mask] += weight[i]
    cost = np.full((full, n), np.inf)
    before = np.full((full, n), -1, np.int64)
    for i in range(n):
        cost[1 << i, i] = start[i] * left[0]
    for mask in range(1, full):
        for last in range(n):
            here = cost[mask, last]
            if not np.isfinite(here):
                continue
            for i in range(n):
                if (mask >> i) & 1:
                    continue
                through = here + between[last, i] * left[mask]
                if through < cost[mask | (1 << i), i]:
                    cost[mask | (1 << i), i] = through
                    before[mask | (1 << i), i] = last
    return cost, before


def best_order(start: np.ndarray, between: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the order of places with the least ``sum_i w_i l_i``, and that sum.

    Args:
        start: ``(n,)`` path length from the robot to each place, m.
        between: ``(n, n)`` path length from place to place, m.
        weight: ``(n,)`` what is gained at each, not negative; up to :data:`MOST_PLACES` places.
    """
    n = len(weight)
    assert 0 < n <= MOST_PLACES
    cost, before = _solve(*(np.asarray(a, np.float64) for a in (start, between, weight)))
    mask, last = (1 << n) - 1, int(np.argmin(cost[-1]))
    total, order = float(cost[-1, last]), []
    while last >= 0:
        order.append(last)
        mask, last = mask & ~(1 << last), int(before[mask, last])
    return np.array(order[::-1]), total
