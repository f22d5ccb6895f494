"""Measure how spread weighted poses of the plane are: entropy of a histogram, and the number of its parts.

    p_b = sum of the weights in bin b,    H = -sum_b p_b log p_b
    modes = connected parts of the smallest set of bins with 95 % of the mass, that hold 1 % or more each

Bins are neighbours where they touch, corners included; headings close a circle.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

BIN_SIDE, BIN_TURN = 0.05, np.radians(22.5)  # m and rad, of a bin
MASS_HELD, LEAST_OF_MODE = 0.95, 0.01  # shares of the mass: of all bins that count, and of one mode
# m and rad: a particle within both of the true pose is at it; the radius of success in a maze, and a bin's turn
AT_POSE, AT_HEADING = 0.05, np.radians(22.5)


class Spread(NamedTuple):
    """Hold the measures of one belief."""

    entropy: float  # nats, over the bins
    modes: int
    largest: float  # share of the mass in the heaviest mode
    at_truth: float  # share of the mass at the true pose


def spread(poses: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n"], true: Float[np.ndarray, "3"]) -> Spread:
    """Measure particles.

    Args:
        poses: x, y (m), heading (rad).
        weight: of each; their sum is 1.
        true: pose, for the share of the mass at it.
    """
    mass = histogram(poses, weight)
    part = parts(mass)
    held = ndimage.sum_labels(mass, part, np.arange(1, part.max() + 1))
    p = mass[mass > 0.0]
    away = np.hypot(*(poses[:, :2] - true[:2]).T)
    turned = np.abs((poses[:, 2] - true[2] + np.pi) % (2.0 * np.pi) - np.pi)
    return Spread(
        entropy=max(0.0, float(-np.sum(p * np.log(p)))),
        modes=int(np.sum(held >= LEAST_OF_MODE)),
        largest=float(held.max(initial=0.0)),
        at_truth=float(weight[(away < AT_POSE) & (turned < AT_HEADING)].sum()),
    )


def histogram(poses: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n"]) -> Float[np.ndarray, "nx ny headings"]:
    """Return the mass in each bin, from the particles' lowest x and y on."""
    headings = round(2.0 * np.pi / BIN_TURN)
    i, j = np.floor((poses[:, :2] - poses[:, :2].min(axis=0)) / BIN_SIDE).astype(int).T
    k = np.floor(poses[:, 2] / BIN_TURN).astype(int) % headings
    mass = np.zeros((i.max() + 1, j.max() + 1, headings))
    np.add.at(mass, (i, j, k), weight)
    return mass


def parts(mass: Float[np.ndarray, "nx ny headings"]) -> Int[np.ndarray, "nx ny headings"]:
    """Return the number of the part that each bin belongs to, from 1; 0: it is not among the bins that count."""
    heaviest_first = np.argsort(mass, axis=None)[::-1]
    before = np.cumsum(mass.flat[heaviest_first]) - mass.flat[heaviest_first]
    counts = np.zeros(mass.shape, bool)
    counts.flat[heaviest_first] = (before < MASS_HELD * mass.sum()) & (mass.flat[heaviest_first] > 0.0)
    # The first heading again after the last: parts that meet there are one
    part, number = ndimage.label(np.concatenate([counts, counts[..., :1]], axis=-1), np.ones((3, 3, 3)))
    same = np.arange(number + 1)
    for a, b in np.unique(part[..., [0, -1]][counts[..., 0]], axis=0):
        same[same == same[b]] = same[a]
    numbers = {old: new for new, old in enumerate(np.unique(same[1:]), 1)}
    return np.array([0, *(numbers[old] for old in same[1:])])[part[..., :-1]]
