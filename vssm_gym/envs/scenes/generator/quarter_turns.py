"""Compute quarter turns, gaps and overlaps of many axis-parallel rectangles and blocks, by comparing numbers."""

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.envs.scenes.apartment_parts import ROUNDING


def turned(rects: Float[np.ndarray, "n 4"], q: int) -> Float[np.ndarray, "n 4"]:
    """Return rectangles (x0, y0, x1, y1) after q quarter turns about the origin."""
    x0, y0, x1, y1 = rects.T
    return np.stack([(x0, y0, x1, y1), (-y1, x0, -y0, x1), (-x1, -y1, -x0, -y0), (y0, -x1, y1, -x0)][q], axis=1)


def turned3(blocks: Float[np.ndarray, "n 6"], q: int) -> Float[np.ndarray, "n 6"]:
    """Return blocks (x0, y0, z0, x1, y1, z1) after q quarter turns about the z axis."""
    flat = turned(blocks[:, [0, 1, 3, 4]], q)
    return np.concatenate([flat[:, :2], blocks[:, 2:3], flat[:, 2:], blocks[:, 5:]], axis=1)


def gaps(a: Float[np.ndarray, "n k 4"], b: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "n k m"]:
    """Return the distance between rectangles, 0 where they meet."""
    a, b = a[:, :, None], b[None, None]
    dx = np.maximum(0.0, np.maximum(a[..., 0] - b[..., 2], b[..., 0] - a[..., 2]))
    dy = np.maximum(0.0, np.maximum(a[..., 1] - b[..., 3], b[..., 1] - a[..., 3]))
    return np.hypot(dx, dy)


def overlap(a: Float[np.ndarray, "n k 4"], b: Float[np.ndarray, "m 4"]) -> Bool[np.ndarray, "n k m"]:
    """Return True where rectangles share more than rounding."""
    a, b = a[:, :, None], b[None, None]
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    return (high - low > ROUNDING).all(axis=-1)


def overlap3(a: Float[np.ndarray, "n 6"], b: Float[np.ndarray, "m 6"]) -> Bool[np.ndarray, "n m"]:
    """Return True where blocks share more than rounding."""
    low, high = np.maximum(a[:, None, :3], b[None, :, :3]), np.minimum(a[:, None, 3:], b[None, :, 3:])
    return (high - low > ROUNDING).all(axis=-1)


def contains(corners: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the test of points (n, 2) in a rectilinear polygon.

    The crossings of its upright edges to their left are odd.
    """
    upright = [(a, b) for a, b in itertools.pairwise([*corners, corners[0]]) if a[0] == b[0]]

    def contains(points: np.ndarray) -> np.ndarray:
        odd = np.zeros(len(points), dtype=bool)
        for a, b in upright:
            odd ^= (points[:, 0] > a[0]) & (points[:, 1] > min(a[1], b[1])) & (points[:, 1] <= max(a[1], b[1]))
        return odd

    return contains
