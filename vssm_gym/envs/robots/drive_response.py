"""Respond to commands as a worn drive does: late, too little, and to one side.

    c' = c + (1 - exp(-dt / lag)) (u - c)      what the drive has reached, of (turn, o, s); at rest c = 0
    c' = 0 where u = 0 and |c'| < 0.05 limit   friction holds a drive that is told to rest, component by component
    (turn, o, s) = gains * c'                  is executed, with noise
    heading += pull * metres driven            and the robot pulls to one side

A robot that plans with what it commands is not told of it.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.errors import InputError

STICTION = 0.05  # of the limit of a command: what is left of a motion that friction ends


@dataclass(frozen=True)
class DriveResponse:
    """Hold how a drive follows the commands ``(turn, o, s)``; the default carries out what is commanded."""

    lag: float = 0.0  # s, time constant
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)  # shares of turn, o and s that the robot makes of a command
    pull: float = 0.0  # rad, a turn to the left for every metre that it drives

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lag) and self.lag >= 0.0):
            raise InputError("DriveResponse", "lag", f"a finite time >= 0 s, not {self.lag!r}")
        if len(self.gains) != 3 or not all(math.isfinite(gain) and gain > 0.0 for gain in self.gains):
            raise InputError("DriveResponse", "gains", f"three finite numbers > 0; found {self.gains!r:.80}")
        if not math.isfinite(self.pull):
            raise InputError("DriveResponse", "pull", f"a finite number, not {self.pull!r}")

    def follow(self, reached: np.ndarray, command: np.ndarray, limits: np.ndarray, dt: float) -> np.ndarray:
        """Return what the drive has reached after a step, rad, rad, m, of what it had reached before.

        Args:
            reached: before the step; zero at rest.
            command: ``(turn, o, s)`` as commanded.
            limits: the largest command.
            dt: length of the step, s.
        """
        left = math.exp(-dt / self.lag) if self.lag > 0.0 else 0.0
        reached = np.asarray(command + left * (reached - command), dtype=np.float64)
        held = (command == 0.0) & (np.abs(reached) < STICTION * limits)
        return np.where(held, 0.0, reached)

    def carried_out(self, reached: np.ndarray) -> np.ndarray:
        """Return the ``(turn, o, s)``, rad, rad, m, that the robot executes where its drive has reached a command."""
        return np.asarray(self.gains) * reached


# The response of robot="worn": a step and a half late, a fifth of a turn lost, and pulled to the right
WORN = DriveResponse(lag=0.4, gains=(0.8, 1.0, 0.85), pull=-0.1)
