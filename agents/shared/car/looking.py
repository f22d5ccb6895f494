"""Find what a car would drive onto unseen, and the poses from which it sees it.

A camera that looks ahead shows what a straight drive leads to, and neither what a turn at full lock sweeps nor what
lies behind. Whether a route's unseen cells are seen before the car is there depends on the poses before, so it is
computed along the route: a cell is seen from a pose if it lies within the camera's angle and no obstacle is between.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car.footprint import footprint_cells, heading_grid

EDGE = np.radians(5.0)  # of the camera's view on either side, which is not counted on
SIGHT_FROM, SIGHT_TO = 0.1, 1.6  # m from the camera, within which a view shows a cell
AHEAD = 12  # motions of a route that are examined: 1.6 m
PATCH = 4  # motions from the first blind one on, whose unseen cells are looked at together
SEEN_MARGIN = 0.045  # m around the footprint that have to be seen: 3 cm around discs that stand out of it are kept free


class Sight:
    """Answer what is seen from where on one floor plan.

    Args:
        occupied: ``(nx, ny)`` bool, which blocks the view.
        unseen: the same, cells that were not seen yet.
        corner: world position of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
        car: whose camera it is.
        half_angle: of the camera's horizontal view, rad.
    """

    def __init__(
        self,
        occupied: np.ndarray,
        unseen: np.ndarray,
        corner: np.ndarray,
        resolution: float,
        car: Car,
        half_angle: float,
    ) -> None:
        self._occupied, self._unseen, self._car = occupied, unseen, car
        self._half_angle = half_angle - EDGE
        self._corner, self._resolution = corner, resolution

    def blind(self, route: np.ndarray, motions: int = PATCH) -> np.ndarray:
        """Return the unseen cells ``(n, 2)`` that the car would meet on a route ``(m, 3)`` without having seen them.

        They are those of so many ``motions``, the first blind one among them; none where there is no blind one.
        """
        k = self.first_blind(route)
        return np.zeros((0, 2), int) if k is None else self.swept(route[k - 1 : k + motions])

    def first_blind(self, route: np.ndarray) -> int | None:
        """Return the index of the first pose of a route ``(m, 3)`` where the car meets cells that it has not seen."""
        return next(self._blind_poses(route), None)

    def risk(self, route: np.ndarray, prices: tuple[float, float]) -> float:
        """Return the price of the motions of a route ``(m, 3)`` that meet cells which the car has not seen.

        Args:
            route: poses, one after each motion.
            prices: of such a motion, forwards and backwards.
        """
        ahead = lambda a, b: np.cos(a[2]) * (b[0] - a[0]) + np.sin(a[2]) * (b[1] - a[1]) >= 0.0
        return sum(prices[0 if ahead(route[k - 1], route[k]) else 1] for k in self._blind_poses(route))

    def _blind_poses(self, route: np.ndarray) -> Iterator[int]:
        """Yield the indices of the poses of a route where the car meets cells that it has not seen."""
        for k in range(1, min(len(route), AHEAD)):
            under = self.unseen_under(route[k])
            if len(under) and not self.seen(between(route[: k + 1])[:-1], under).all():
                yield k

    def first_met(self, route: np.ndarray) -> int | None:
        """Return the index of the pose to which a route's first motion over unseen cells leads, seen before or not."""
        return next((k for k in range(1, len(route)) if len(self.swept(route[k - 1 : k + 1]))), None)

    def swept(self, route: np.ndarray) -> np.ndarray:
        """Return the unseen cells ``(n, 2)`` that the motions of a route meet, their beginning left out."""
        return np.unique(np.concatenate([self.unseen_under(pose) for pose in between(route)]), axis=0)

    def seen(self, poses: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return which cells ``(n, 2)`` are seen from any of the poses ``(m, 3)``, ``(n,)`` bool."""
        if len(poses) == 0:
            return np.zeros(len(cells), bool)
        camera = self._camera(poses)[:, None]
        to = self._corner + self._resolution * cells - camera
        away = np.hypot(to[..., 0], to[..., 1])
        off = np.abs(wrap_angle(np.arctan2(to[..., 1], to[..., 0]) - poses[:, None, 2]))
        looks = (off <= self._half_angle) & (away >= SIGHT_FROM) & (away <= SIGHT_TO)
        pose, cell = np.nonzero(looks)
        clear = self._clear(camera[pose, 0], to[pose, cell], self._occupied)
        found = np.zeros(len(cells), bool)
        found[cell[clear]] = True
        return found

    def viewpoints(self, patch: np.ndarray, n_headings: int) -> np.ndarray:
        """Return the poses of the grid from which the middle of a patch of cells is seen through what is known.

        Returns:
            ``(nx, ny, n_headings)`` bool.
        """
        nx, ny = self._occupied.shape
        middle = patch[np.abs(patch - patch.mean(axis=0)).sum(axis=1).argmin()]
        xy = self._corner + self._resolution * middle
        hidden = self._occupied | self._unseen
        hidden[tuple(patch.T)] = False
        cells = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1)
        places = self._corner + self._resolution * cells
        to = xy - places
        away = np.hypot(to[..., 0], to[..., 1])
        clear = (away >= 2.0 * SIGHT_FROM) & (away <= SIGHT_TO) & ~hidden
        clear[clear] = self._clear(places[clear], to[clear], hidden)
        bearing = np.arctan2(to[..., 1], to[..., 0])
        shows = np.zeros((nx, ny, n_headings), bool)
        for k, heading in enumerate(heading_grid(n_headings)):
            aims = clear & (np.abs(wrap_angle(bearing - heading)) <= 0.7 * self._half_angle)
            shift = np.round(self._car.camera_forward * np.array([np.cos(heading), np.sin(heading)]) / self._resolution)
            at = np.argwhere(aims) - shift.astype(int)
            at = at[np.all((at >= 0) & (at < (nx, ny)), axis=1)]
            shows[at[:, 0], at[:, 1], k] = True
        return shows

    def unseen_under(self, planar: np.ndarray) -> np.ndarray:
        """Return the unseen cells ``(n, 2)`` under the footprint at a pose, and within :data:`SEEN_MARGIN` of it."""
        cells = footprint_cells(self._corner, self._resolution, planar, self._car, SEEN_MARGIN)
        cells = cells[np.all((cells >= 0) & (cells < self._unseen.shape), axis=1)]
        return cells[self._unseen[tuple(cells.T)]]

    def _camera(self, poses: np.ndarray) -> np.ndarray:
        """Return where the camera is at poses ``(n, 3)``, ``(n, 2)``, m."""
        ahead = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=-1)
        return poses[:, :2] + self._car.camera_forward * ahead

    def _clear(self, start: np.ndarray, to: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        """Return where no hidden cell lies on the segment from ``start`` along ``to``, both ``(n, 2)``, m."""
        share = np.linspace(0.0, 1.0, int(SIGHT_TO / self._resolution) + 2)[:-1, None]
        points = start[:, None] + share * to[:, None]
        cell = np.floor((points - self._corner) / self._resolution + 0.5).astype(int)
        cell = np.clip(cell, 0, np.array(hidden.shape) - 1)
        return ~hidden[cell[..., 0], cell[..., 1]].any(axis=1)


def between(route: np.ndarray) -> np.ndarray:
    """Return the poses ``(3 m - 3, 3)`` of a route ``(m, 3)`` at each third of a motion, the first pose left out."""
    ends = np.column_stack([route[:, :2], np.unwrap(route[:, 2])])
    return np.array([a + share * (b - a) for a, b in pairwise(ends) for share in (1.0 / 3.0, 2.0 / 3.0, 1.0)])
