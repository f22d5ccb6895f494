"""Keep where a robot was and when, at every step of a run."""

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.protocols.episode import StepRecord


class Track:
    """Collect the true poses of a run.

    Attributes:
        path: ``(3,)`` x, y (m), heading (rad) of every step.
        seconds: time of every step.
    """

    def __init__(self) -> None:
        self.path: list[np.ndarray] = []
        self.seconds: list[float] = []

    def add(self, step: StepRecord) -> None:
        """Add one step."""
        self.path.append(step.planar)
        self.seconds.append(step.seconds)

    def until(self, seconds: float) -> Float[np.ndarray, "n 2"]:
        """Return the path up to a time (s), m."""
        n = int(np.searchsorted(self.seconds, seconds)) + 1
        return np.array(self.path[:n])[:, :2]
