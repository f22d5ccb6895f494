"""Follow a drive by a disc that drives along its heading and then turns."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.transforms import wrap_angle

AHEAD_WIDTH = 0.6  # of a disc's radius, to either side of its heading


class Progress(NamedTuple):
    """Locate a robot beside a path."""

    segment: int  # nearest to it
    point: np.ndarray  # (2,) of the path, nearest to it, m
    distance: float  # to that point, m


def progress(path: Float[np.ndarray, "n 2"], xy: Float[np.ndarray, "2"], first: int = 0, last: int = 12) -> Progress:
    """Return where a robot is beside the segments ``first`` to ``first + last`` of a path."""
    a, b = path[:-1][first : first + last], path[1:][first : first + last]
    d = b - a
    share = np.clip(np.sum((xy - a) * d, axis=1) / np.maximum(np.sum(d * d, axis=1), 1e-18), 0.0, 1.0)
    points = a + share[:, None] * d
    away = np.hypot(*(points - xy).T)
    k = int(np.argmin(away))
    return Progress(first + k, points[k], float(away[k]))


def ahead_of(path: Float[np.ndarray, "n 2"], at: Progress, distance: float) -> np.ndarray:
    """Return the point of the path that lies ``distance`` m farther along it; its end where it is shorter."""
    here = at.point
    for corner in path[at.segment + 1 :]:
        step = math.hypot(*(corner - here))
        if step >= distance:
            return here + (corner - here) * (distance / step)
        here, distance = corner, distance - step
    return path[-1]


def follow(
    pose: Float[np.ndarray, "3"],
    path: Float[np.ndarray, "n 2"],
    at: Progress,
    limits: Float[np.ndarray, "2"],
    look: float,
    faced: float,
) -> tuple[float, float]:
    """Return the command (turn, distance): rad, m, within the limits.

    Args:
        pose: x, y (m), heading (rad).
        path: x, y of its corners, m.
        at: where the robot is beside it.
        limits: largest turn and step.
        look: distance along the path of the point that is aimed at, m.
        faced: angle from its bearing within which the robot drives, rad.
    """
    most_turn, most_step = (float(v) for v in limits)
    aim = ahead_of(path, at, look)
    error = float(wrap_angle(_bearing(pose[:2], aim) - pose[2]))
    if abs(error) > faced:
        return float(np.clip(error, -most_turn, most_turn)), 0.0
    step = min(most_step, math.hypot(*(aim - pose[:2])))
    after = pose[:2] + step * np.array([math.cos(pose[2]), math.sin(pose[2])])
    beyond = ahead_of(path, at, look + step)
    if math.hypot(*(beyond - after)) < 0.25 * look:  # the end: no direction is left to turn to
        return 0.0, step
    turn = float(wrap_angle(_bearing(after, beyond) - pose[2]))
    return float(np.clip(turn, -most_turn, most_turn)), step


def free_ahead(ranges: Float[np.ndarray, "beams"], angles: Float[np.ndarray, "beams"], radius: float) -> float:
    """Return how far a disc can drive along its heading before it meets a reading, m.

    Readings beside it, beyond :data:`AHEAD_WIDTH` of its radius, do not count: it passes them,
    and their noise would stop it.
    """
    ahead, beside = ranges * np.cos(angles), ranges * np.sin(angles)
    met = (ranges > 0.0) & (ahead > 0.0) & (np.abs(beside) < AHEAD_WIDTH * radius)
    reach = ahead[met] - np.sqrt(radius**2 - beside[met] ** 2)
    return float(max(0.0, reach.min(initial=np.inf)))


def _bearing(xy: np.ndarray, to: np.ndarray) -> float:
    return math.atan2(to[1] - xy[1], to[0] - xy[0])
