"""Let an image of the user's be the goal of ImageNav: where it was taken is unknown, so success cannot be judged."""

from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import UInt8

JUDGED = ("success", "spl", "soft_spl", "geodesic", "distance_to_goal", "failure", "goal")
"""Fields of a row that are about a goal's place, which is unknown here."""


class GivenImage(gym.ObservationWrapper):
    """Show ``image`` as ``observation["goal_rgb"]``; the task's own goal, a stand-in, is observed nowhere."""

    def __init__(self, env: gym.Env, image: UInt8[np.ndarray, "height width 3"]) -> None:
        super().__init__(env)
        self._image = image

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with the given image in place of that of the task's goal."""
        return {**observation, "goal_rgb": self._image.copy()}


def unjudged(row: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a row with None for those that depend on the place of the goal."""
    return row | dict.fromkeys(JUDGED)
