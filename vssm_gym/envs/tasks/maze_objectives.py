"""What a maze's robot is asked for: to get near a goal, or to visit every tile. Each says what a step gained.

approach:  gain_t = d(xy_t-1) - d(xy_t),  d the distance to the goal along free space, m
coverage:  gain_t = side of a tile (m) for every tile visited for the first time
"""

from typing import Protocol

import numpy as np
import shapely
from jaxtyping import Float

from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.tasks.goal_progress import GoalDistance
from vssm_gym.envs.tasks.navigation import Task

TILES = 10  # along each side of the unit square: coverage counts tiles, as the thesis' exploration ratio does
TILE = 1.0 / TILES  # m
OPEN = 0.5  # share of a tile that must be free for it to count


class Objective(Protocol):
    """``begin`` an episode, say what each position ``gained`` and whether it is ``reached``."""

    def begin(self, task: Task) -> None:
        """A new episode at the task's start."""

    def gained(self, xy: Float[np.ndarray, "2"]) -> float:
        """Metres won by coming to ``xy``; to be called once a step."""

    def reached(self, xy: Float[np.ndarray, "2"]) -> bool:
        """Whether it is done at ``xy``."""


class Approach:
    """Come within ``radius`` m of the task's goal; without ``dense`` nothing is gained on the way."""

    def __init__(self, space: FreeSpace, body_length: float, radius: float, dense: bool) -> None:
        # An edge of sqrt(5) spacings is shorter than the body: no edge crosses a wall, however thin.
        self._distance = GoalDistance(space, 0.4 * body_length) if dense else None
        self._radius, self._goal, self._away = radius, np.zeros(2), np.inf

    def begin(self, task: Task) -> None:
        """See :class:`Objective`."""
        self._goal = np.asarray(task.goal)
        if self._distance is not None:
            self._distance.aim(self._goal)
            self._away = self._distance(np.asarray(task.start[:2]))

    def gained(self, xy: Float[np.ndarray, "2"]) -> float:
        """See :class:`Objective`; 0 where no node of the grid of free positions is near."""
        before, now = self._away, np.inf if self._distance is None else self._distance(xy)
        self._away = now if np.isfinite(now) else before
        return before - now if np.isfinite(now) and np.isfinite(before) else 0.0

    def reached(self, xy: Float[np.ndarray, "2"]) -> bool:
        """Within the radius."""
        return bool(np.hypot(*(xy - self._goal)) <= self._radius)


class MazeCoverage:
    """Visit every tile of which at least half is free; :attr:`ratio` is the share visited, the exploration ratio."""

    def __init__(self, space: FreeSpace) -> None:
        low = TILE * np.stack(np.meshgrid(np.arange(TILES), np.arange(TILES), indexing="ij"), axis=-1)
        tiles = shapely.box(low[..., 0], low[..., 1], low[..., 0] + TILE, low[..., 1] + TILE)
        self.counted = shapely.area(shapely.intersection(tiles, space.region)) >= OPEN * TILE**2  # (TILES, TILES)
        self.visited = np.zeros_like(self.counted)

    @property
    def ratio(self) -> float:
        """Share of the counted tiles that were visited."""
        return float(self.visited.sum() / max(1, self.counted.sum()))

    def begin(self, task: Task) -> None:
        """See :class:`Objective`; the tile of the start is visited."""
        self.visited[:] = False
        self.gained(np.asarray(task.start[:2]))

    def gained(self, xy: Float[np.ndarray, "2"]) -> float:
        """See :class:`Objective`; a tile counts where a step ends in it."""
        i, j = np.clip((xy / TILE).astype(int), 0, TILES - 1)
        new = bool(self.counted[i, j] and not self.visited[i, j])
        self.visited[i, j] |= new
        return TILE if new else 0.0

    def reached(self, xy: Float[np.ndarray, "2"]) -> bool:
        """Every counted tile was visited."""
        return bool((self.visited == self.counted).all())
