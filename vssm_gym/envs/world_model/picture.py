"""Where imagined robots are on the belief's floor plan: free white, blocked dark, unobserved grey."""

import numpy as np

from vssm_gym.envs.rendering.topdown import PICTURE
from vssm_gym.envs.world_model.collision_map import Ground

FREE, BLOCKED, UNKNOWN = (255, 255, 255), (60, 60, 70), (190, 190, 195)
PATH, ROBOT, GOAL = (200, 60, 50), (40, 90, 200), (70, 170, 90)
REMEMBERED = 1000  # positions of a path


class PlanPicture:
    """Draws the first map; paths are what was drawn since the episode began."""

    def __init__(self, ground: Ground, robots: int) -> None:
        nx, ny = ground.shape
        clearance, known = ground.mean(), np.asarray(ground.known).reshape(nx, ny)
        plan = np.empty((nx, ny, 3), np.uint8)
        plan[:] = FREE
        plan[clearance <= 0.0] = BLOCKED
        plan[~known] = UNKNOWN
        self._metres = ny * ground.resolution / PICTURE  # a pixel
        rows = ((np.arange(PICTURE) + 0.5) / PICTURE * ny).astype(int)
        width = max(1, round(nx * PICTURE / ny))
        columns = ((np.arange(width) + 0.5) / width * nx).astype(int)
        self._plan = np.ascontiguousarray(plan[columns][:, rows].transpose(1, 0, 2)[::-1])  # y up
        self._origin = np.asarray(ground.origin, np.float64) - 0.5 * ground.resolution
        v, u = np.mgrid[0:PICTURE, 0:width]
        self._x = self._origin[0] + (u + 0.5) * self._metres
        self._y = self._origin[1] + (PICTURE - v - 0.5) * self._metres
        self._paths: list[list[np.ndarray]] = [[] for _ in range(robots)]

    def forget(self, which: np.ndarray) -> None:
        """New episodes: their paths begin anew."""
        for i in which:
            self._paths[i] = []

    def draw(self, planar: np.ndarray, goals: np.ndarray, reach: float, radius: float) -> tuple[np.ndarray, ...]:
        """One picture a robot, uint8 ``(360, width, 3)``."""
        pictures = []
        for path, pose, goal in zip(self._paths, planar, goals, strict=True):
            path.append(pose[:2])
            del path[:-REMEMBERED]
            picture = self._plan.copy()
            self._disc(picture, goal, reach, GOAL)
            for xy in path:
                self._disc(picture, xy, 0.03, PATH)
            self._disc(picture, pose[:2], radius, ROBOT)
            ahead = pose[:2] + radius * np.array([np.cos(pose[2]), np.sin(pose[2])])
            self._disc(picture, ahead, 0.5 * radius, ROBOT)
            pictures.append(picture)
        return tuple(pictures)

    def _disc(self, picture: np.ndarray, xy: np.ndarray, radius: float, colour: tuple[int, int, int]) -> None:
        picture[(self._x - xy[0]) ** 2 + (self._y - xy[1]) ** 2 <= max(radius, self._metres) ** 2] = colour
