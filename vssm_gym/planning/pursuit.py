"""Follow a path: turn in place towards the next waypoint, then drive straight at it (the controller of TNP-SM, eq. P7).

With ``e = bearing(waypoint) - heading``: where ``|e| > max_offset`` the robot turns, ``(clip(e), 0, 0)``; else it
drives, ``(0, e, min(max_step, distance))``. Its direction offset ``o`` makes small corrections, because every turning
command adds a heading error that does not depend on its size, and an offset adds none.

A robot whose directions are those of the world never waits for a turn: it drives along the bearing, and turns
meanwhile until it faces where it drives, ``(clip(e), bearing, min(max_step, distance))``.
"""

import math

import numpy as np

from vssm_gym.geometry.axes import DirectionFrame
from vssm_gym.geometry.transforms import wrap_angle

# m; a bend so near counts as passed, because a shorter step adds more noise than progress. The end of the path is
# driven to at any distance.
BEND_PASSED = 0.02
FACING = math.radians(5.0)  # in the world frame, within this angle of its direction the robot does not turn


def steer(
    planar: np.ndarray,
    path: np.ndarray,
    limits: np.ndarray,
    direction_frame: DirectionFrame = "body",
    passed: float = BEND_PASSED,
) -> np.ndarray:
    """Return the command that follows ``path`` from ``planar``.

    A step never passes a waypoint, so the robot moves along the path's segments and cuts no corner. The step that
    arrives at a waypoint already turns towards the next one. That saves a step, and turning later would add the same
    error.

    Args:
        planar: ``(3,)`` the robot's x, y (m) and heading (rad).
        path: ``(n, 2)`` waypoints, metres, world frame; the first is where the robot is and is not aimed at.
        limits: ``(3,)`` largest turn (rad), direction (rad) and step (m).
        direction_frame: of the command's ``o``.
        passed: m, distance at which a bend counts as passed.

    Returns:
        ``(turn, o, s)`` float64 within the limits; all zero at the path's end.
    """
    max_turn, max_offset, max_step = (float(v) for v in limits)
    relative = direction_frame == "body"
    faced = max_offset if relative else FACING
    x, y, heading = (float(v) for v in planar)
    ahead = [(float(px), float(py)) for px, py in np.asarray(path)[1:]]
    while len(ahead) > 1 and math.hypot(ahead[0][0] - x, ahead[0][1] - y) < passed:
        ahead = ahead[1:]
    px, py = ahead[0] if ahead else (x, y)
    distance = math.hypot(px - x, py - y)
    if distance == 0.0:
        return np.zeros(3)
    bearing = math.atan2(py - y, px - x)
    error = aim = _angle(bearing - heading)
    if relative and abs(error) > max_offset:
        return np.array([_clip(error, max_turn), 0.0, 0.0])
    if distance <= max_step and len(ahead) > 1:
        aim = _angle(math.atan2(ahead[1][1] - py, ahead[1][0] - px) - heading)
    turn = _clip(aim, max_turn) if abs(aim) > faced else 0.0
    return np.array([turn, error if relative else bearing, min(distance, max_step)])


def direction_of_travel(planar: np.ndarray, command: np.ndarray, direction_frame: DirectionFrame) -> float:
    """Return the direction in the world, rad, in which a robot at ``planar`` drives by a command ``(turn, o, s)``."""
    return float(command[1]) + (float(planar[2]) if direction_frame == "body" else 0.0)


def _angle(angle: float) -> float:
    return float(wrap_angle(np.float64(angle)))


def _clip(value: float, bound: float) -> float:
    return max(-bound, min(bound, value))
