"""Choose places from which the map does not show what a picture could show, once no frontier is left.

A floor plan without frontiers says that the floor is known, and nothing of walls that no image has shown. The
panoramas of :class:`~vssm_gym.agents.shared.searching.picture_search.PictureSearch` say which views are not in the map:

    place = argmax_p V(p) exp(-lambda (d(p) + c |turn|))      V: headings at p whose view is unseen
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.exploration.candidates import Roadmap


@dataclass(frozen=True)
class UnseenViewsConfig:
    """Configure which views are unseen, and the price of the way to one."""

    share: float = 0.6  # of a view that the map shows; less is unseen
    least: float = 0.5  # rad of unseen headings that a place must have
    decay: float = 0.3  # lambda, 1/m
    turn: float = 0.8  # c, m of path that a turn by a radian costs as much as
    window: float = 0.75  # rad to each side of a heading that an image there shows
    near: float = 0.6  # m around a place that has been looked from, within which the same headings are done


class UnseenViews:
    """Hold the view that the robot drives to, and those that it has looked at."""

    def __init__(self, config: UnseenViewsConfig) -> None:
        self._config = config
        self.chosen: np.ndarray | None = None  # (3,) place and heading
        self._looked: list[np.ndarray] = []

    def choose(self, places: np.ndarray, shares: np.ndarray, roadmap: Roadmap, planar: np.ndarray) -> np.ndarray | None:
        """Return the next place ``(2,)``, m; None where every view is in the map.

        Args:
            places: ``(n, 2)`` m.
            shares: ``(n, columns)`` of the view at each heading ``2 pi k / columns`` that the map shows.
            roadmap: of the present floor plan.
            planar: pose of the robot.
        """
        c, self.chosen = self._config, None
        if not len(places):
            return None
        columns = shares.shape[1]
        headings = 2.0 * math.pi * np.arange(columns) / columns
        unseen = shares < c.share
        for pose in self._looked:
            near = np.hypot(*(places - pose[:2]).T) < c.near
            unseen[np.ix_(near, np.abs(wrap_angle(headings - pose[2])) < c.window)] = False
        count = unseen.sum(axis=1)
        away = roadmap.at(roadmap.distance, places)
        x, y = (places - planar[:2]).T
        turns = np.where(np.hypot(x, y) > 0.3, np.abs(wrap_angle(np.arctan2(y, x) - planar[2])), 0.0)
        value = count * np.exp(-c.decay * (away + c.turn * turns))
        value[count * 2.0 * math.pi / columns < c.least] = 0.0
        best = int(np.argmax(value))
        if not value[best] > 0.0:
            return None
        around = np.abs(wrap_angle(headings[:, None] - headings[None, :])) < c.window
        heading = headings[int(np.argmax(around.astype(int) @ unseen[best]))]
        self.chosen = np.array([*places[best], heading])
        return places[best]

    def close(self) -> None:
        """End the choice: the robot has looked, or cannot."""
        if self.chosen is not None:
            self._looked.append(self.chosen)
        self.chosen = None
