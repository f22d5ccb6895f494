"""Drive a disc that moves along its heading: follow a path, and see from a scan how far it can drive ahead."""

import math

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.transforms import wrap_angle

ALIGNED_ENOUGH = math.radians(15.0)  # heading error up to which the robot drives while it turns
MINDED_COSINE = (
    0.5  # of a reading's bearing from the motion: what is beside the robot is no obstacle, whatever noise says
)
LEAVES = 0.1  # m of free space beyond which one direction out of a tight place is as good as another
LOOKS_AHEAD = 0.03  # m along the path, to the point that it drives at


def follow(
    pose: Float[np.ndarray, "3"],
    path: Float[np.ndarray, "n 2"],
    limits: Float[np.ndarray, "2"],
    ahead: float = LOOKS_AHEAD,
) -> Float[np.ndarray, "2"]:
    """Return the command ``(turn rad, step m)`` that follows a path; zeros at its end.

    Args:
        pose: x, y (m), heading (rad).
        path: points no farther apart than they are to be looked ahead at, m.
        limits: largest turn (rad) and step (m).
        ahead: of the point that it drives at, along the path, m.
    """
    nearest = int(np.argmin(np.hypot(*(path - pose[:2]).T)))
    farther = np.flatnonzero(np.cumsum(np.hypot(*np.diff(path[nearest:], axis=0).T)) >= ahead)
    target = path[nearest + 1 + farther[0]] if len(farther) else path[-1]
    distance = float(np.hypot(*(target - pose[:2])))
    if distance < 0.25 * limits[1]:
        return np.zeros(2)
    off = float(wrap_angle(math.atan2(*(target - pose[:2])[::-1]) - pose[2]))
    turn = float(np.clip(off, -limits[0], limits[0]))
    return np.array([turn, min(distance, float(limits[1])) if abs(off) <= ALIGNED_ENOUGH else 0.0])


def follow_safely(
    pose: Float[np.ndarray, "3"],
    path: Float[np.ndarray, "n 2"],
    scan: Float[np.ndarray, "beams"],
    limits: Float[np.ndarray, "2"],
    half_width: float,
) -> Float[np.ndarray, "2"] | None:
    """Return the command that follows a path and meets nothing that the scan shows; None at the path's end or if none.

    A point far ahead cuts corners: where the way to it is not free the next points before it are tried.
    """
    for share in (1.0, 0.6, 0.3):
        command = follow(pose, path, limits, share * LOOKS_AHEAD)
        if not command.any():
            return None
        if command[1] == 0.0 or free_ahead(scan, 0.0, half_width) >= command[1]:
            return command
    return None


def leave(
    scan: Float[np.ndarray, "beams"], limits: Float[np.ndarray, "2"], half_width: float
) -> Float[np.ndarray, "2"]:
    """Return the command that turns a robot to where most is free, and drives it there: out of a tight place."""
    bearings = 2.0 * np.pi * np.arange(len(scan)) / len(scan)
    free = np.array([free_ahead(scan, bearing, half_width) for bearing in bearings])
    off = float(wrap_angle(bearings[int(np.argmax(np.minimum(free, LEAVES) - 1e-3 * np.abs(wrap_angle(bearings))))]))
    turn = float(np.clip(off, -limits[0], limits[0]))
    return np.array([turn, min(float(limits[1]), max(0.0, float(free[0]))) if abs(off) <= ALIGNED_ENOUGH else 0.0])


def free_ahead(scan: Float[np.ndarray, "beams"], bearing: float, half_width: float) -> float:
    """Return the length (m) that a disc can drive at a bearing (rad) before it meets a measured point."""
    read = scan > 0.0  # 0: no measurement
    angles = 2.0 * np.pi * np.arange(len(scan))[read] / len(scan) - bearing
    ahead, beside = scan[read] * np.cos(angles), np.abs(scan[read] * np.sin(angles))
    met = (beside < half_width) & (np.cos(angles) > MINDED_COSINE)
    reach = ahead[met] - np.sqrt(np.maximum(0.0, half_width**2 - beside[met] ** 2))
    return float(reach.min(initial=np.inf))
