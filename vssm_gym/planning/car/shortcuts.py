"""Shorten a drive: find the cheapest path through its own poses, where a Reeds-Shepp curve may replace any piece (P14).

    J(k) = min over i < k of J(i) + cost(i -> k),    i -> k: a free curve, or the drive itself from i to i + 1

A dynamic program over poses picked from the drive, cusps among them, so the result never costs more than the drive,
except for changes of the steering at the picked poses.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.planning.car import reeds_shepp
from vssm_gym.planning.car.footprint_levels import TIGHT, Lookup, level_at
from vssm_gym.planning.car.hybrid_search import Costs, cheapest_curve

PICKS = 40  # poses of the drive between which curves are tried


def shortcut(
    lookup: Lookup, poses: np.ndarray, gears: np.ndarray, radius: float, costs: Costs
) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortened drive, sampled as finely as the table's cells: poses ``(m, 3)`` and gears ``(m,)``."""
    if len(poses) < 3:
        return poses, gears
    cusps = np.flatnonzero(np.diff(gears))
    picks = np.unique(np.concatenate([np.linspace(0, len(poses) - 1, PICKS).astype(int), cusps]))
    before, curves, replaced = _best_pieces(lookup, poses, gears.astype(np.float64), picks, radius, costs)
    rows: list[np.ndarray] = []
    signs: list[np.ndarray] = []
    k = len(picks) - 1
    while k > 0:
        i = before[k]
        if replaced[k]:
            word = curves[k]
            curve = reeds_shepp.ReedsSheppPath(poses[picks[i]], word[:, 0], word[:, 1].astype(np.int8), radius)
            points, sign = reeds_shepp.sample(curve, lookup.resolution)
            rows.insert(0, points[1:])
            signs.insert(0, sign[1:])
        else:
            rows.insert(0, poses[picks[i] + 1 : picks[k] + 1])
            signs.insert(0, gears[picks[i] + 1 : picks[k] + 1])
        k = i
    return np.concatenate([poses[:1], *rows]), np.concatenate([signs[0][:1], *signs])


@njit(cache=True, nogil=True)
def _piece_cost(lookup, poses, gears, first, last, costs):
    """Return the cost of the drive between two of its poses, including the cusps between them."""
    total = 0.0
    for k in range(first + 1, last + 1):
        step = math.hypot(poses[k, 0] - poses[k - 1, 0], poses[k, 1] - poses[k - 1, 1])
        level = level_at(lookup, poses[k, 0], poses[k, 1], poses[k, 2])
        near = costs.tight if level == TIGHT else (costs.collision if level > TIGHT else 0.0)
        total += step * (1.0 + near + (costs.reverse if gears[k] < 0.0 else 0.0))
        if k > first + 1 and gears[k] != gears[k - 1]:
            total += costs.cusp
    return total


@njit(cache=True, nogil=True)
def _best_pieces(lookup, poses, gears, picks, radius, costs):
    """Return predecessors, curves ``(n, 5, 2)``, and True where a curve leads to a pick, by dynamic programming."""
    n = picks.shape[0]
    value = np.full(n, np.inf)
    gear, steering = np.zeros(n), np.zeros(n)
    before = np.zeros(n, np.int64)
    curves = np.zeros((n, 5, 2))
    replaced = np.zeros(n, np.bool_)
    word = np.zeros((5, 2))
    value[0] = 0.0
    for k in range(1, n):
        i = k - 1
        a = gears[picks[i] + 1]
        value[k] = value[i] + _piece_cost(lookup, poses, gears, picks[i], picks[k], costs)
        value[k] += costs.cusp if a * gear[i] < 0.0 else 0.0
        before[k], gear[k] = i, gears[picks[k]]
        steering[k] = _share(poses, gears, picks[k], radius)
        value[k] += costs.steer * abs(steering[k] - steering[i])
        for i in range(k):
            bound = value[k] - value[i] - 1e-9
            if bound <= 0.0:
                continue
            start, end = poses[picks[i]], poses[picks[k]]
            total = cheapest_curve(lookup, start, end, radius, gear[i], steering[i], costs, bound, word)
            if total < bound:
                value[k], before[k], replaced[k] = value[i] + total, i, True
                curves[k] = word
                for s in range(5):
                    if abs(word[s, 0]) > 1e-9:
                        gear[k] = 1.0 if word[s, 0] > 0.0 else -1.0
                        steering[k] = word[s, 1]
    return before, curves, replaced


@njit(cache=True, nogil=True)
def _share(poses, gears, k, radius):
    """Return the steering, as a fraction of the full lock, that leads to pose ``k`` of the drive."""
    step = math.hypot(poses[k, 0] - poses[k - 1, 0], poses[k, 1] - poses[k - 1, 1])
    turn = poses[k, 2] - poses[k - 1, 2]
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    return max(-1.0, min(1.0, gears[k] * turn * radius / max(step, 1e-9)))
