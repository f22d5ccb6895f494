"""``T' = T exp(s, 0, turn)`` in NumPy and numba: the float64 twin of :func:`vssm_gym.model.transition.bicycle.arc`.

An arc of signed length ``s`` that turns by ``turn`` has the chord ``s sinc(turn / 2)``, in the direction of its middle.
Planners of the car that do not run in JAX compute their motions here. ``tests/model/test_bicycle_twins.py`` compares
this module, and every planner's motions, with the transition.
"""

import math

import numpy as np
from numba import njit

from vssm_gym.geometry.transforms import wrap_angle


def turn_of(length: float | np.ndarray, steering: float | np.ndarray, wheelbase: float) -> np.ndarray:
    """Return turns ``s tan(steering) / wheelbase`` (rad, left positive) of arcs of signed length ``s`` (m)."""
    return np.asarray(length * np.tan(steering) / wheelbase)


def chord_of(length: float | np.ndarray, turn: float | np.ndarray) -> np.ndarray:
    """Return ``s sinc(turn / 2)``: signed chords (m) of arcs of signed ``length`` (m) that turn by ``turn`` (rad)."""
    return np.asarray(length * np.sinc(0.5 * turn / np.pi))


def poses_after(
    heading: float | np.ndarray,
    length: float | np.ndarray,
    turn: float | np.ndarray,
    x: float | np.ndarray = 0.0,
    y: float | np.ndarray = 0.0,
) -> np.ndarray:
    """Drive arcs of signed ``length`` (m) that turn by ``turn`` (rad) from poses ``(x, y, heading)``; all broadcast.

    Returns:
        ``(..., 3)`` float64; headings are not wrapped.
    """
    chord, direction = chord_of(length, turn), heading + 0.5 * turn
    return np.stack(
        np.broadcast_arrays(x + chord * np.cos(direction), y + chord * np.sin(direction), heading + turn), axis=-1
    )


def arc_between(start: np.ndarray, end: np.ndarray, wheelbase: float) -> tuple[float, float]:
    """Return the arc that joins two poses ``(3,)``: its signed length (m) and steering (rad); inverts poses_after."""
    turn = float(wrap_angle(end[2] - start[2]))
    direction = start[2] + 0.5 * turn
    chord = math.cos(direction) * (end[0] - start[0]) + math.sin(direction) * (end[1] - start[1])
    # The sign is that of the way along the mean heading; two poses of a car need not lie on one arc exactly.
    length = float(np.copysign(np.hypot(*(end[:2] - start[:2])) / np.sinc(0.5 * turn / np.pi), chord))
    return length, float(np.arctan(wheelbase * turn / length))


@njit(cache=True, nogil=True)
def pose_after(x: float, y: float, heading: float, chord: float, turn: float) -> tuple[float, float, float]:
    """Drive one arc with a given signed ``chord`` (m) that turns by ``turn`` (rad); the heading is not wrapped.

    Compiled searches pass many short arcs, whose chords they know or approximate: ``s (1 - turn^2 / 24)`` has an error
    of ``s turn^4 / 1920``, ``s`` one of ``s turn^2 / 24``.
    """
    direction = heading + 0.5 * turn
    return x + chord * math.cos(direction), y + chord * math.sin(direction), heading + turn
