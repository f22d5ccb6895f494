"""Define the objectives of a maze's robot: approach a goal, or visit every tile.

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

TILES = 10  # along each side of the unit square: coverage counts tiles, as the exploration ratio of DVBF-LM does
TILE = 1.0 / TILES  # m
OPEN_SHARE = 0.5  # fraction of a tile that must be free for it to count


class Objective(Protocol):
    """Reward each position by what it gained, and decide when the task is done."""

    def begin(self, task: Task) -> None:
        """Start an episode at the task's start."""

    def gained(self, xy: Float[np.ndarray, "2"]) -> float:
        """Return the gain of coming to ``xy``, m; to be called once a step."""

    def reached(self, xy: Float[np.ndarray, "2"]) -> bool:
        """Return True if the task is done at ``xy``."""


class Approach:
    """Come within ``radius`` m of the task's goal; without ``dense`` the gain is always 0."""

    def __init__(self, space: FreeSpace, body_length: float, radius: float, dense: bool) -> None:
        # An edge of sqrt(5) spacings is shorter than the body: no edge crosses a wall, however thin.
        self._distance = GoalDistance(space, 0.4 * body_length) if dense else None
        self._radius, self._goal, self._away = radius, np.zeros(2), np.inf

    def begin(self, task: Task) -> None:
        """Start an episode towards the task's goal."""
        self._goal = np.asarray(task.goal)
        if self._distance is not None:
            self._distance.aim(self._goal)
            self._away = self._distance(np.asarray(task.start[:2]))

    def gained(self, xy: Float[np.ndarray, "2"]) -> float:
        """Return the progress, m; 0 where no node of the grid of free positions is near."""
        before, now = self._away, np.inf if self._distance is None else self._distance(xy)
        self._away = now if np.isfinite(now) else before
        return before - now if np.isfinite(now) and np.isfinite(before) else 0.0

    def reached(self, xy: Float[np.ndarray, "2"]) -> bool:
        """Return True within the radius."""
        return bool(np.hypot(*(xy - self._goal)) <= self._radius)


class MazeCoverage:
    """Visit every tile of which at least half is free; :attr:`ratio` is the exploration ratio."""

    def __init__(self, space: FreeSpace) -> None:
        low = TILE * np.stack(np.meshgrid(np.arange(TILES), np.arange(TILES), indexing="ij"), axis=-1)
        tiles = shapely.box(low[..., 0], low[..., 1], low[..., 0] + TILE, low[..., 1] + TILE)
        self.counted = shapely.area(shapely.intersection(tiles, space.region)) >= OPEN_SHARE * TILE**2  # (TILES, TILES)
        self.visited = np.zeros_like(self.counted)

    @property
    def ratio(self) -> float:
        """Return the fraction of the counted tiles that were visited."""
        return float(self.visited.sum() / max(1, self.counted.sum()))

    def begin(self, task: Task) -> None:
        """Start an episode; the tile of the start is visited."""
        self.visited[:] = False
        self.gained(np.asarray(task.start[:2]))

    def gained(self, xy: Float[np.ndarray, "2"]) -> float:
        """Return a tile's side, m, if this step ended in a new tile, else 0."""
        i, j = np.clip((xy / TILE).astype(int), 0, TILES - 1)
        new = bool(self.counted[i, j] and not self.visited[i, j])
        self.visited[i, j] |= new
        return TILE if new else 0.0

    def reached(self, xy: Float[np.ndarray, "2"]) -> bool:
        """Return True if every counted tile was visited."""
        return bool((self.visited == self.counted).all())
