"""Define the motions of the car on a grid of poses: arcs of one length that end on headings of the grid (eq. P17).

    T' = T exp(s, 0, turn),  s = +-length,  turn = b 2 pi / n_headings,  steering = atan(wheelbase turn / length)

The sharpest arc is driven at full lock, which fixes the length: ``length = max(b) (2 pi / n_headings) turning_radius``.
A motion that starts at a cell centre with a heading of the grid ends with a heading of the grid, so only x and y of the
successor lie between grid points. The poses are those of the bicycle in NumPy (:mod:`vssm_gym.geometry.arc`), not in
JAX: their cells decide which poses are neighbours, so even the last bit of a heading of the grid matters.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.arc import poses_after
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Kernel, cells_under, dilate, heading_grid

MAX_MOTIONS = 31  # one bit each in a signed word of 32 bits


@dataclass(frozen=True)
class Motions:
    """Hold arcs forwards, then the same arcs backwards.

    Attributes:
        car: Whose arcs they are.
        n_headings: Headings of the grid.
        turns: ``b``, steps of the heading grid that each forward arc turns to the left; a backward arc with the same
            steering turns by ``-b``.
        length: Of each arc of the rear axle, m.
    """

    car: Car
    n_headings: int
    turns: tuple[int, ...]
    length: float

    @classmethod
    def of(cls, car: Car, n_headings: int = 64, turns: tuple[int, ...] = (-3, -1, 0, 1, 3)) -> "Motions":
        """Make arcs forwards and backwards at one steering each of ``turns``; the largest is full lock."""
        if n_headings < 8:
            raise InputError("motions", "n_headings", f"at least 8 headings; found {n_headings}")
        if not turns or len(set(turns)) != len(turns) or max(map(abs, turns)) == 0:
            raise InputError("motions", "turns", f"distinct whole numbers, not only 0; found {turns}")
        if 2 * len(turns) > MAX_MOTIONS:
            raise InputError("motions", "turns", f"at most {MAX_MOTIONS // 2} steerings; found {len(turns)}")
        length = max(map(abs, turns)) * 2.0 * np.pi / n_headings * car.turning_radius
        return cls(car, n_headings, tuple(turns), float(length))

    @property
    def heading_steps(self) -> np.ndarray:
        """Return the turn of each motion in steps of the heading grid, int ``(n_motions,)``."""
        return np.array([*self.turns, *(-b for b in self.turns)])

    @property
    def controls(self) -> np.ndarray:
        """Return ``(speed, steering)`` of each motion at full speed, m/s and rad, ``(n_motions, 2)``."""
        turn = 2.0 * np.pi / self.n_headings * np.array(self.turns)
        steering = np.arctan(self.car.wheelbase * turn / self.length)
        speed = np.repeat([self.car.max_speed, -self.car.max_speed], len(self.turns))
        return np.stack([speed, np.tile(steering, 2)], axis=-1)

    def along(self, share: np.ndarray) -> np.ndarray:
        """Return the poses after a ``share`` in [0, 1] of each motion from each heading at the origin.

        Returns:
            ``(n_headings, n_motions, *share.shape, 3)`` float64; headings are not wrapped.
        """
        share = np.asarray(share, dtype=np.float64)
        ahead = np.repeat([self.length, -self.length], len(self.turns))
        turn = 2.0 * np.pi / self.n_headings * self.heading_steps
        expand = (slice(None), *(None,) * share.ndim)
        angle = turn[expand] * share
        headings = heading_grid(self.n_headings)[:, None][(..., *(None,) * share.ndim)]
        return poses_after(headings, ahead[expand] * share, angle)

    @property
    def displacements(self) -> np.ndarray:
        """Return ``(x, y)`` in metres at the end of each motion from each heading, ``(n_headings, n_motions, 2)``."""
        return self.along(np.array(1.0))[..., :2]

    def collisions(self, occupied: np.ndarray, resolution: float, margin: float) -> np.ndarray:
        """Test each arc from each cell centre: True where the rectangle overlaps an occupied cell anywhere on it.

        The footprint is tested at poses half a cell or less apart, for whichever of its corners moves farthest.

        Returns:
            Bool ``(n_headings, n_motions, nx, ny)``.
        """
        blocked = dilate(occupied, _swept_cells(self, float(resolution), float(margin)))
        return blocked.reshape(self.n_headings, len(self.heading_steps), *np.shape(occupied))


@lru_cache(maxsize=4)  # depends on the car and the grid, not on the map
def _swept_cells(motions: Motions, resolution: float, margin: float) -> tuple[Kernel, ...]:
    """Return the cells under the arc of each heading and motion, in this order."""
    corner = np.abs(motions.car.corners(np.zeros(3))).max(axis=0) + margin
    sharpest = 1.0 / motions.car.turning_radius
    farthest = motions.length * np.hypot(1.0 + sharpest * corner[1], sharpest * corner[0])
    n = int(np.ceil(farthest / (0.5 * resolution)))
    poses = motions.along(np.linspace(0.0, 1.0, n + 1)).reshape(-1, n + 1, 3)
    return tuple(Kernel.of(cells_under(arc, resolution, motions.car, margin)) for arc in poses)
