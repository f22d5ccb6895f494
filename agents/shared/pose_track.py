"""Remember the poses at which a robot knew where it was."""

import math
from dataclasses import dataclass, field

import numpy as np

MOVED = 0.1, 0.2  # m, rad: a pose nearer than both to the last one is not remembered
AS_NEAR = 0.1  # m beyond the nearest pose, within which the latest is taken


@dataclass
class PoseTrack:
    """Keep the poses ``(3,)`` (m and rad) that were believed, in order."""

    poses: list[np.ndarray] = field(default_factory=list)

    def add(self, planar: np.ndarray) -> None:
        """Remember a pose that is believed, where it is another one."""
        moved = planar - self.poses[-1] if self.poses else np.full(3, np.inf)
        if math.hypot(*moved[:2]) > MOVED[0] or abs(moved[2]) > MOVED[1]:
            self.poses.append(planar.copy())

    def nearest(self, planar: np.ndarray) -> np.ndarray:
        """Return the pose nearest to ``planar``, the latest of several."""
        poses = np.array(self.poses)
        away = np.hypot(*(poses[:, :2] - planar[:2]).T)
        return poses[np.flatnonzero(away <= away.min() + AS_NEAR)[-1]]
