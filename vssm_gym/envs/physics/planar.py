"""Compute exact ray ranges and sliding contacts among rectangles in the plane.

A rectangle is the horizontal section of an upright box. A ray meets it where the slabs of its two axes overlap. A disc
of radius R is in contact with it where the disc's centre meets the rectangle grown by R, whose corners are circles.
Lengths are in metres, angles in rad, world frame. The loops are compiled (numba) and release the interpreter lock.

    rectangles: ``(m, 6)`` float64, one row ``(x, y, cos yaw, sin yaw, half length, half width)``
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numba import njit

from vssm_gym.envs.scenes.solids import SolidBox

# m: a disc is stopped this far from an obstacle, so that rounding never puts it inside: the rounding of a million steps
# is smaller by some orders of magnitude.
SKIN = 1e-6
MOST_CONTACTS = 8  # walls that one step may slide along; the rest of the step is not driven
_CONTACT = 1.0 + 1e-12  # squared distances up to this multiple of the squared radius are contacts, to rounding
_LEAST = 1e-12  # m: a shorter push moves nothing, and none is so short that its square vanishes
_PARALLEL = 1e-30  # a direction's smallest component: its inverse stays finite, and 0 times it is 0


def rectangles(boxes: Sequence[SolidBox], z: float | None = None) -> Float[np.ndarray, "m 6"]:
    """Return the rectangles of ``boxes``, or of those that the plane at height ``z`` cuts."""
    cut = [box for box in boxes if z is None or abs(z - box.center[2]) < 0.5 * box.size[2]]
    rows = [(*b.center[:2], math.cos(b.yaw), math.sin(b.yaw), 0.5 * b.size[0], 0.5 * b.size[1]) for b in cut]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


@njit(cache=True, nogil=True)
def scan(poses: np.ndarray, rectangles: np.ndarray, beams: int) -> np.ndarray:
    """``r_k = min {r >= 0: p + r u(heading + 2 pi k / beams) in a rectangle}``: beam 0 ahead, counter-clockwise.

    Args:
        poses: ``(n, 3)`` float64, ``(x, y, heading)`` of n scanners.
        rectangles: ``(m, 6)``, see the module.
        beams: number of beams.

    Returns:
        ``(n, beams)`` float64; 0 inside a rectangle, inf where a ray meets none.
    """
    ranges = np.full((len(poses), beams), np.inf)
    cosine, sine = np.empty(beams), np.empty(beams)
    for i in range(len(poses)):
        for k in range(beams):
            angle = poses[i, 2] + 2.0 * np.pi * k / beams
            cosine[k], sine[k] = math.cos(angle), math.sin(angle)
        for j in range(len(rectangles)):
            x, y, c, s, half_x, half_y = rectangles[j]
            x, y = poses[i, 0] - x, poses[i, 1] - y
            x, y = c * x + s * y, c * y - s * x
            for k in range(beams):
                enter, leave = _crossing(x, y, c * cosine[k] + s * sine[k], c * sine[k] - s * cosine[k], half_x, half_y)
                if enter <= leave and leave >= 0.0:
                    ranges[i, k] = min(ranges[i, k], max(enter, 0.0))
    return ranges


@njit(cache=True, nogil=True)
def clearance(x: float, y: float, rectangles: np.ndarray) -> float:
    """Return the distance from a point to the nearest rectangle, m; 0 inside one, inf where there is none."""
    nearest = np.inf
    for j in range(len(rectangles)):
        at_x, at_y, c, s, half_x, half_y = rectangles[j]
        at_x, at_y = x - at_x, y - at_y
        away_x, away_y = _away(c * at_x + s * at_y, c * at_y - s * at_x, half_x, half_y)
        nearest = min(nearest, math.hypot(away_x, away_y))
    return nearest


@njit(cache=True, nogil=True)
def slide(x: float, y: float, dx: float, dy: float, radius: float, rectangles: np.ndarray) -> tuple[float, float, bool]:
    """Push a disc at ``(x, y)`` by ``(dx, dy)`` and return where it ends, and True if it collided with a rectangle.

    At a contact with normal n the rest d of the push becomes ``d - min(0, d . n) n``: walls stop without friction.
    The centre keeps ``radius + SKIN`` from every rectangle (to rounding), if it did so before.
    """
    grown = radius + SKIN
    collided = False
    for _ in range(MOST_CONTACTS):
        if math.hypot(dx, dy) < _LEAST:
            break
        first, normal_x, normal_y = 1.0, 0.0, 0.0
        for j in range(len(rectangles)):
            centre_x, centre_y, c, s, half_x, half_y = rectangles[j]
            at_x, at_y = x - centre_x, y - centre_y
            at_x, at_y = c * at_x + s * at_y, c * at_y - s * at_x
            to_x, to_y = c * dx + s * dy, c * dy - s * dx
            at = _contact(at_x, at_y, to_x, to_y, half_x, half_y, grown)
            if at < first:
                first = at
                away_x, away_y = _away(at_x + at * to_x, at_y + at * to_y, half_x, half_y)
                distance = math.hypot(away_x, away_y)
                away_x, away_y = away_x / distance, away_y / distance
                normal_x, normal_y = c * away_x - s * away_y, s * away_x + c * away_y
        x, y = x + first * dx, y + first * dy
        if first == 1.0:
            break
        collided = True
        dx, dy = (1.0 - first) * dx, (1.0 - first) * dy
        into = min(0.0, dx * normal_x + dy * normal_y)
        dx, dy = dx - into * normal_x, dy - into * normal_y
    return x, y, collided


@njit(cache=True, nogil=True)
def _contact(x: float, y: float, dx: float, dy: float, half_x: float, half_y: float, grown: float) -> float:
    """Return the fraction of ``d`` after which the point meets the rectangle grown by a disc; inf where it does not."""
    away_x, away_y = _away(x, y, half_x, half_y)
    if away_x * away_x + away_y * away_y <= _CONTACT * grown * grown:
        # Touching already: the grown rectangle is convex, so a point that does not move inwards never enters it.
        inwards = away_x * dx + away_y * dy < 0.0
        return 0.0 if inwards else np.inf
    first = np.inf
    for more_x, more_y in ((grown, 0.0), (0.0, grown)):
        enter, leave = _crossing(x, y, dx, dy, half_x + more_x, half_y + more_y)
        if enter <= leave and enter >= 0.0:
            first = min(first, enter)
    square = dx * dx + dy * dy
    for corner_x in (-half_x, half_x):
        for corner_y in (-half_y, half_y):
            from_x, from_y = x - corner_x, y - corner_y
            along = from_x * dx + from_y * dy
            root = along * along - square * (from_x * from_x + from_y * from_y - grown * grown)
            if along < 0.0 and root >= 0.0:
                first = min(first, max(0.0, (-along - math.sqrt(root)) / square))
    return first


@njit(cache=True, nogil=True)
def _crossing(x: float, y: float, dx: float, dy: float, half_x: float, half_y: float) -> tuple[float, float]:
    """Return where the line ``p + t d`` enters and leaves an upright rectangle around the origin.

    Enter > leave: a miss.
    """
    over_x = 1.0 / (dx if abs(dx) > _PARALLEL else _PARALLEL)
    over_y = 1.0 / (dy if abs(dy) > _PARALLEL else _PARALLEL)
    one_x, other_x = (-half_x - x) * over_x, (half_x - x) * over_x
    one_y, other_y = (-half_y - y) * over_y, (half_y - y) * over_y
    return max(min(one_x, other_x), min(one_y, other_y)), min(max(one_x, other_x), max(one_y, other_y))


@njit(cache=True, nogil=True)
def _away(x: float, y: float, half_x: float, half_y: float) -> tuple[float, float]:
    """Return the vector from the nearest point of an upright rectangle around the origin to ``(x, y)``; zero inside."""
    return x - min(max(x, -half_x), half_x), y - min(max(y, -half_y), half_y)
