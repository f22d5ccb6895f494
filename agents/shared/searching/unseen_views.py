"""Choose places from which the map does not show what a picture could show, once no frontier is left.

A floor plan without frontiers says that the floor is known, and nothing of walls that no image has shown. The
panoramas of :class:`~vssm_gym.agents.shared.searching.picture_search.PictureSearch` say which views are not in the map:

    (p, h) = argmax V(p, h) exp(-lambda (d(p) + c (|b(p)| + |h - b(p)|)))

``V`` counts the unseen headings at the place p that an image with the heading h shows, ``d`` is the path length to p,
and ``b`` the bearing of p: the robot turns to where it drives, and once more where it looks.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.exploration.candidates import Roadmap

SAME_PLACE = 0.01  # m
STAYS = 0.3  # m, from which on the robot turns to where it drives


@dataclass(frozen=True)
class UnseenViewsConfig:
    """Configure which views are unseen, and the price of the way to one."""

    share: float = 0.6  # of a view that the map shows; less is unseen
    least: float = 0.5  # rad of unseen headings that a place must have
    decay: float = 0.3  # lambda, 1/m
    turn: float = 0.8  # c, m of path that a turn by a radian costs as much as
    margin: float = 0.035  # rad, of the camera's view that is not counted on
    near: float = 0.6  # m around a place that has been looked from, within which the same headings are done


class UnseenViews:
    """Hold the view that the robot drives to, and those that it has looked at."""

    def __init__(self, config: UnseenViewsConfig, camera: Camera) -> None:
        self._config = config
        # rad to each side of a heading that an image there shows
        self._window = math.atan(0.5 * camera.width / float(np.asarray(camera.fx))) - config.margin
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
            unseen[np.ix_(near, np.abs(wrap_angle(headings - pose[2])) < self._window)] = False
        around = np.abs(wrap_angle(headings[:, None] - headings[None, :])) < self._window
        shown = unseen.astype(np.float32) @ around.astype(np.float32)
        shown[unseen.sum(axis=1) * 2.0 * math.pi / columns < c.least] = 0.0
        x, y = (places - planar[:2]).T
        bearing = np.where(np.hypot(x, y) > STAYS, np.arctan2(y, x), planar[2])
        turns = np.abs(wrap_angle(bearing - planar[2]))[:, None] + np.abs(wrap_angle(headings - bearing[:, None]))
        value = shown * np.exp(-c.decay * (roadmap.at(roadmap.distance, places)[:, None] + c.turn * turns))
        best, column = np.unravel_index(int(np.argmax(value)), value.shape)
        if not value[best, column] > 0.0:
            return None
        self.chosen = np.array([*places[best], headings[column]])
        return places[best]

    def is_seen(self, places: np.ndarray, shares: np.ndarray) -> bool:
        """Return True where the map shows by now what the chosen view was to show; arguments as of :meth:`choose`."""
        if self.chosen is None or not len(places):
            return False
        away = np.hypot(*(places - self.chosen[:2]).T)
        if away.min() > SAME_PLACE:
            return False
        columns = shares.shape[1]
        within = np.abs(wrap_angle(2.0 * math.pi * np.arange(columns) / columns - self.chosen[2])) < self._window
        unseen = np.count_nonzero(shares[int(away.argmin()), within] < self._config.share)
        return bool(unseen * 2.0 * math.pi / columns < self._config.least)

    def close(self) -> None:
        """End the choice: the robot has looked, or cannot."""
        if self.chosen is not None:
            self._looked.append(self.chosen)
        self.chosen = None
