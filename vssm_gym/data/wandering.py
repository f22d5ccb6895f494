"""Draw commands that show how a robot moves: all turns, directions and steps, together and apart, held for a while.

A survey turns on the spot or drives ahead at full speed; a model that is learned from it does not know what happens
between. Here each command is drawn from all that the robot can do, and held for up to two seconds.
"""

import numpy as np
from jaxtyping import Float

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.errors import InputError

HELD_STEPS = (1, 10)  # steps for which a command is held
NO_TURN, NO_STEP, NO_OFFSET = 0.25, 0.15, 0.3  # shares of commands without a turn, without a step, straight ahead
MARGINS = (0.15, 0.1, 0.05, 0.02)  # m beyond the robot's side, tried in this order: room for a drive that lags
LOOK_AHEAD = 3  # steps of the commanded length that must be free


class Wanderer:
    """Draw the commands of a holonomic robot on its way through free space.

    It knows the floor plan and the true pose, as the driver of a recording does.

    Args:
        apartment: the scene.
        robot: that drives.
        seed: of the commands.
    """

    def __init__(self, apartment: Apartment, robot: Robot, seed: int) -> None:
        self._limits = robot.limits
        self._free = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
        self._space = _roomy(self._free)
        self._rng = np.random.default_rng(seed)
        self._command, self._left = np.zeros(3), 0

    def __call__(self, planar: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the next command ``(turn, o, s)``, rad, rad, m.

        Args:
            planar: the robot's x, y (m) and heading (rad).
        """
        if not self._left:
            self._command, self._left = self._drawn(), int(self._rng.integers(HELD_STEPS[0], HELD_STEPS[1] + 1))
        if self._is_free(planar, self._command):
            self._left -= 1
            return self._command
        return np.array([np.copysign(self._limits[0], self._command[0]), 0.0, 0.0])  # until the way is free

    def _drawn(self) -> Float[np.ndarray, "3"]:
        """Draw a command."""
        rng, (turn, direction, step) = self._rng, self._limits
        return np.array(
            [
                0.0 if rng.random() < NO_TURN else rng.uniform(-turn, turn),
                0.0 if rng.random() < NO_OFFSET else rng.uniform(-direction, direction),
                0.0 if rng.random() < NO_STEP else rng.uniform(0.0, step),
            ]
        )

    def _is_free(self, planar: np.ndarray, command: np.ndarray) -> bool:
        """Return whether the robot has room in the direction of a command, or gets to where it has room."""
        if not command[2]:
            return True
        angle = planar[2] + command[1]
        ahead = np.arange(1, LOOK_AHEAD + 1)[:, None] * command[2] * np.array([np.cos(angle), np.sin(angle)])
        here, there = planar[:2], planar[:2] + ahead
        if self._space.contains(here):
            return bool(self._space.contains(there).all())
        gets_nearer = self._missing(there[-1]) < self._missing(here)
        return bool(gets_nearer and (self._free.contains(there).all() or not self._free.contains(here)))

    def _missing(self, xy: np.ndarray) -> float:
        """Return the distance of a place to the nearest one with room, m."""
        return float(np.linalg.norm(self._space.nearest(xy) - xy))


def _roomy(space: FreeSpace) -> FreeSpace:
    """Return the free space with the largest margin that leaves any."""
    for margin in MARGINS:
        try:
            return space.widened(margin)
        except InputError:
            continue
    return space
