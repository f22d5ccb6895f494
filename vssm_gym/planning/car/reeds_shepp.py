"""Compute Reeds-Shepp curves: ``min sum |l_i|`` over arcs of radius R and straights, in both gears (eq. P12).

With the unit turning circle, a word is a list of signed lengths ``l_i`` (negative: backwards) at steerings ``s_i`` in
{1 left, 0 straight, -1 right}. The shortest path has one of 48 words of the kinds CSC, CCC, CCCC, CCSC, CSCC, CCSCC
(Reeds and Shepp, "Optimal paths for a car that goes both forwards and backwards", Pacific J. of Mathematics 145, 1990).

Each word is solved from the centres of its first and its last circle. At pose ``(p, a)`` the left circle's centre is
``p + n(a)`` and the right one's ``p - n(a)``, ``n(a) = (-sin a, cos a)``; a cusp or a bend leaves the old circle, so
that ``D``, the last centre less the first, is a sum of few such vectors. Signs follow from the geometry: every
solution reaches the goal, so the least of them is the shortest whichever signs its word has, and no candidate is lost
to rounding at the border between two words.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.geometry.arc import poses_after
from vssm_gym.geometry.transforms import wrap_angle

LEFT, STRAIGHT, RIGHT = 1, 0, -1  # steering of a segment, share of the full lock
SOLUTIONS = 40  # solutions a pair of poses can have: 8 CSC, 4 CCC, 8 CCCC, 8 CCSC, 8 CSCC, 4 CCSCC
_QUARTER = 0.5 * math.pi  # rad, a quarter turn


@dataclass(frozen=True)
class ReedsSheppPath:
    """Hold arcs and straights from ``start``, driven in order.

    Attributes:
        start: ``(3,)`` x, y (m), heading (rad).
        lengths: ``(n,)`` signed lengths of the segments, m; negative backwards.
        steerings: ``(n,)`` int8, 1 left, 0 straight, -1 right.
        radius: of every arc, m.
    """

    start: np.ndarray
    lengths: np.ndarray
    steerings: np.ndarray
    radius: float

    @property
    def length(self) -> float:
        """Return ``sum |l_i|``, m."""
        return float(np.abs(self.lengths).sum())

    @property
    def cusps(self) -> int:
        """Return how often the car stops to change its direction."""
        return int(np.count_nonzero(np.diff(np.sign(self.lengths))))


def length(start: np.ndarray, goal: np.ndarray, radius: float) -> np.ndarray:
    """Return the length (m) of the shortest path between poses ``(..., 3)``, which broadcast; float64 ``(...)``."""
    start, goal = np.broadcast_arrays(_poses(start, "start"), _poses(goal, "goal"))
    _check_radius(radius)
    values = _lengths(np.ascontiguousarray(start).reshape(-1, 3), np.ascontiguousarray(goal).reshape(-1, 3), radius)
    return values.reshape(start.shape[:-1])


def path(start: np.ndarray, goal: np.ndarray, radius: float) -> ReedsSheppPath:
    """Return the shortest path between two poses ``(3,)``, of equal ones that of the fewest segments.

    It is without segments where the poses are the same.
    """
    start, goal = _poses(start, "start"), _poses(goal, "goal")
    _check_radius(radius)
    if start.shape != (3,) or goal.shape != (3,):
        raise InputError("reeds_shepp", "start, goal", f"shape (3,); found {start.shape}, {goal.shape}")
    lengths, steerings = np.empty((SOLUTIONS, 5)), np.empty((SOLUTIONS, 5), np.int8)
    count = words(*relative(start[0], start[1], start[2], goal[0], goal[1], goal[2], radius), lengths, steerings)
    total = np.abs(lengths[:count]).sum(axis=1)
    shortest = np.flatnonzero(total <= total.min() + 1e-12)  # words of equal length differ by rounding
    best = int(shortest[np.argmin(np.count_nonzero(np.abs(lengths[shortest]) > 1e-12, axis=1))])
    driven = np.flatnonzero(np.abs(lengths[best]) > 1e-12)
    return ReedsSheppPath(start, radius * lengths[best, driven], steerings[best, driven], float(radius))


def sample(curve: ReedsSheppPath, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return poses ``(n, 3)`` along ``curve``, at most ``step`` m apart and at every joint, and gears int8 ``(n,)``.

    A gear is 1 forwards or -1 backwards up to its pose; the first one is that of the first segment.
    """
    if not step > 0.0:
        raise InputError("reeds_shepp", "step", f"a positive length in metres; found {step!r:.80}")
    poses, gears = [curve.start[None]], [np.zeros(1, np.int8)]
    for driven, steering in zip(curve.lengths, curve.steerings, strict=True):
        if abs(driven) < 1e-9:
            continue  # a segment that rounding left over has no gear
        count = math.ceil(abs(driven) / step - 1e-9) or 1
        s = driven * np.arange(1, count + 1) / count
        poses.append(_along(poses[-1][-1], s, steering / curve.radius))
        gears.append(np.full(count, 1 if driven > 0.0 else -1, np.int8))
    gear = np.concatenate(gears)
    gear[0] = gear[1] if len(gear) > 1 else 1
    return np.concatenate(poses), gear


def _along(pose: np.ndarray, s: np.ndarray, curvature: float) -> np.ndarray:
    """Return poses ``(n, 3)`` at the signed lengths ``s`` along an arc, headings in [-pi, pi)."""
    poses = poses_after(pose[2], s, s * curvature, pose[0], pose[1])
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses


def _poses(value: np.ndarray, field: str) -> np.ndarray:
    poses = np.asarray(value, dtype=np.float64)
    if poses.ndim == 0 or poses.shape[-1] != 3 or not np.isfinite(poses).all():
        raise InputError("reeds_shepp", field, f"finite poses (..., 3): x, y, heading; found shape {poses.shape}")
    return poses


def _check_radius(radius: float) -> None:
    if not (math.isfinite(radius) and radius > 0.0):
        raise InputError("reeds_shepp", "radius", f"a positive length in metres; found {radius!r:.80}")


@njit(cache=True, nogil=True)
def relative(
    x: float, y: float, heading: float, gx: float, gy: float, goal_heading: float, radius: float
) -> tuple[float, float, float]:
    """Return the goal seen from the start, in turning radii: ``(x, y, heading)``."""
    dx, dy, c, s = (gx - x) / radius, (gy - y) / radius, math.cos(heading), math.sin(heading)
    return c * dx + s * dy, c * dy - s * dx, goal_heading - heading


@njit(cache=True, nogil=True)
def _lengths(start, goal, radius):
    """Evaluate :func:`length` of rows ``(n, 3)``."""
    values = np.empty(start.shape[0])
    for k in range(start.shape[0]):
        x, y, a = relative(start[k, 0], start[k, 1], start[k, 2], goal[k, 0], goal[k, 1], goal[k, 2], radius)
        values[k] = radius * shortest(x, y, a)
    return values


@njit(cache=True, nogil=True)
def shortest(x: float, y: float, heading: float) -> float:
    """Return the length of the shortest path from the origin to a pose, both in turning radii."""
    lengths, steerings = np.empty((SOLUTIONS, 5)), np.empty((SOLUTIONS, 5), np.int8)
    best = np.inf
    for k in range(words(x, y, heading, lengths, steerings)):
        total = 0.0
        for i in range(5):
            total += abs(lengths[k, i])
        best = min(best, total)
    return best


@njit(cache=True, nogil=True)
def words(x: float, y: float, heading: float, lengths: np.ndarray, steerings: np.ndarray) -> int:
    """Compute every solution of every word from the origin to a pose, in turning radii; return their number.

    Rows of ``lengths`` and ``steerings`` ``(SOLUTIONS, 5)`` are filled from the first on, unused segments with zeros.
    """
    count = 0
    for side in (LEFT, RIGHT):  # a mirror image of the goal is reached by the mirror image of the word
        count = _csc_ccc_cccc(x, side * y, side * heading, side, lengths, steerings, count)
        count = _ccsc(x, side * y, side * heading, side, lengths, steerings, count)
        count = _ccscc(x, side * y, side * heading, side, lengths, steerings, count)
        # CSCC: the path from the goal to the start, seen from the goal, is a CCSC; drive it from its end to its start.
        c, s = math.cos(heading), math.sin(heading)
        back = count
        count = _ccsc(-c * x - s * y, side * (s * x - c * y), -side * heading, side, lengths, steerings, count)
        for k in range(back, count):
            for i in range(2):
                j = 3 - i
                lengths[k, i], lengths[k, j] = -lengths[k, j], -lengths[k, i]
                steerings[k, i], steerings[k, j] = steerings[k, j], steerings[k, i]
    return count


@njit(cache=True, nogil=True)
def _wrap(angle):
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@njit(cache=True, nogil=True)
def _put(lengths, steerings, k, side, l0, s0, l1, s1, l2, s2, l3, s3, l4, s4):
    """Write row ``k``; steerings are those of a word that starts to the left, mirrored where ``side`` is right."""
    lengths[k, 0], lengths[k, 1], lengths[k, 2], lengths[k, 3], lengths[k, 4] = l0, l1, l2, l3, l4
    steerings[k, 0], steerings[k, 1], steerings[k, 2] = side * s0, side * s1, side * s2
    steerings[k, 3], steerings[k, 4] = side * s3, side * s4
    return k + 1


@njit(cache=True, nogil=True)
def _csc_ccc_cccc(x, y, a, side, lengths, steerings, k):
    """Solve the words without a forced quarter turn: LSL, LSR, LRL, and LRLR with middle arcs of one length."""
    # To the goal's left circle: LSL has D = u e(t), LRL has D = 4 sin(u / 2) e(t - u / 2), e(a) = (cos a, sin a)
    dx, dy = x - math.sin(a), y - 1.0 + math.cos(a)
    rho, towards = math.hypot(dx, dy), math.atan2(dy, dx)
    for sign in (1, -1):
        t = _wrap(towards + (0.0 if sign > 0 else math.pi))
        k = _put(lengths, steerings, k, side, t, 1, sign * rho, 0, _wrap(a - t), 1, 0.0, 0, 0.0, 0)
        if rho <= 4.0:
            u = sign * 2.0 * math.asin(0.25 * rho)
            t2 = _wrap(t + 0.5 * u)
            k = _put(lengths, steerings, k, side, t2, 1, u, -1, _wrap(a - t2 + u), 1, 0.0, 0, 0.0, 0)
    # To its right circle: LSR has D = u e(t) - 2 n(t)
    dx, dy = x + math.sin(a), y - 1.0 - math.cos(a)
    rho, towards = math.hypot(dx, dy), math.atan2(dy, dx)
    for sign in (1, -1):
        if rho >= 2.0:
            u = sign * math.sqrt(rho * rho - 4.0)
            t = _wrap(towards + math.atan2(2.0, u))
            k = _put(lengths, steerings, k, side, t, 1, u, 0, _wrap(t - a), -1, 0.0, 0, 0.0, 0)
        # L R(u) L(-u) R: D = 2 (1 - 2 cos u) n(t - u); the other root has arcs beyond a right angle, never shortest
        if rho <= 2.0:
            u = sign * math.acos(0.25 * (2.0 + rho))
            t = _wrap(towards + _QUARTER + u)
            k = _put(lengths, steerings, k, side, t, 1, u, -1, -u, 1, _wrap(t - 2.0 * u - a), -1, 0.0, 0)
        # L R(u) L(u) R: D = 2 n(t - u) - 4 n(t), in the frame of heading t: (2 sin u, 2 cos u - 4)
        cosine = (20.0 - rho * rho) / 16.0
        if abs(cosine) <= 1.0:
            u = sign * math.acos(cosine)
            t = _wrap(towards - math.atan2(2.0 * math.cos(u) - 4.0, 2.0 * math.sin(u)))
            k = _put(lengths, steerings, k, side, t, 1, u, -1, u, 1, _wrap(t - a), -1, 0.0, 0)
    return k


@njit(cache=True, nogil=True)
def _ccsc(x, y, a, side, lengths, steerings, k):
    """Solve L R(-q) S R and L R(-q) S L, q = +-pi / 2, with D = (u - 2) e(b) [+ 2 n(b)], b the straight's heading."""
    for sign in (1, -1):  # of q: for -1 the car drives everything in the other gear
        dx, dy = x + math.sin(a), y - 1.0 - math.cos(a)
        rho = math.hypot(dx, dy)
        b = math.atan2(-sign * dy, -sign * dx)
        t = _wrap(b - sign * _QUARTER)
        k = _put(
            lengths, steerings, k, side, t, 1, -sign * _QUARTER, -1, sign * (2.0 - rho), 0, _wrap(b - a), -1, 0.0, 0
        )
        dx, dy = x - math.sin(a), y - 1.0 + math.cos(a)
        rho = math.hypot(dx, dy)
        if rho >= 2.0:
            root = math.sqrt(rho * rho - 4.0)
            b = math.atan2(dy, dx) - math.atan2(2.0, -sign * root)
            t = _wrap(b - sign * _QUARTER)
            k = _put(
                lengths, steerings, k, side, t, 1, -sign * _QUARTER, -1, sign * (2.0 - root), 0, _wrap(a - b), 1, 0.0, 0
            )
    return k


@njit(cache=True, nogil=True)
def _ccscc(x, y, a, side, lengths, steerings, k):
    """Solve L R(-q) S L(-q) R, q = +-pi / 2; the straight has heading ``b`` and D = (u - 4) e(b) + 2 n(b)."""
    dx, dy = x + math.sin(a), y - 1.0 - math.cos(a)
    rho = math.hypot(dx, dy)
    if rho < 2.0:
        return k
    root = math.sqrt(rho * rho - 4.0)
    for sign in (1, -1):
        q = sign * _QUARTER
        b = math.atan2(dy, dx) - math.atan2(2.0, -sign * root)
        k = _put(
            *(lengths, steerings, k, side, _wrap(b - q), 1, -q, -1, sign * (4.0 - root), 0, -q, 1, _wrap(b - q - a), -1)
        )
    return k
