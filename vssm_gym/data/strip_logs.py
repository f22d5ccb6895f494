"""Hold a drive of a robot that sees one row of pixels all around: what a laser log holds, with images as scans."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.data.laser_logs import integrated


@dataclass(frozen=True)
class StripLog:
    """Hold the strips of one drive; lengths in m, angles in rad.

    Attributes:
        images: RGB of each strip.
        angles: of its columns on the robot, counter-clockwise from ahead.
        motions: pose of the robot at a strip, seen from the strip before, by the odometry: forward, left, turn.
        poses: x, y, heading at each strip, the true ones of a simulation; for a judge.
    """

    images: UInt8[np.ndarray, "scans columns 3"]
    angles: Float[np.ndarray, "columns"]
    motions: Float[np.ndarray, "motions 3"]
    poses: Float[np.ndarray, "scans 3"] | None

    def __len__(self) -> int:
        """Return the number of strips."""
        return len(self.images)

    def path(self) -> Float[np.ndarray, "scans 3"]:
        """Return the poses by the odometry alone, from the origin: path integration."""
        return integrated(self.motions)

    def part(self, first: int, last: int) -> "StripLog":
        """Return the strips from ``first`` to before ``last``."""
        poses = None if self.poses is None else self.poses[first:last]
        return StripLog(self.images[first:last], self.angles, self.motions[first : last - 1], poses)
