"""Draw imagined robots on the belief's floor plan: free white, blocked dark, unobserved grey."""

import numpy as np

from vssm_gym.envs.rendering.captions import Panel
from vssm_gym.envs.rendering.topdown import PICTURE
from vssm_gym.envs.world_model.collision_map import CollisionMap

MAP_FREE, MAP_BLOCKED, MAP_UNKNOWN = (255, 255, 255), (60, 60, 70), (190, 190, 195)  # RGB
MAP_PATH, MAP_ROBOT, MAP_GOAL = (200, 60, 50), (40, 90, 200), (70, 170, 90)  # RGB
MAP_LEGEND = {"path": MAP_PATH, "robot": MAP_ROBOT, "goal": MAP_GOAL, "blocked": MAP_BLOCKED, "unobserved": MAP_UNKNOWN}
DRAWN_POSITIONS = 1000  # positions of a path that are drawn


class PlanPicture:
    """Draw robots on the plan of the first map; a path holds the positions drawn since its episode began."""

    def __init__(self, collision_map: CollisionMap, robots: int) -> None:
        nx, ny = collision_map.shape
        clearance, known = collision_map.mean(), np.asarray(collision_map.known).reshape(nx, ny)
        plan = np.empty((nx, ny, 3), np.uint8)
        plan[:] = MAP_FREE
        plan[clearance <= 0.0] = MAP_BLOCKED
        plan[~known] = MAP_UNKNOWN
        self._metres = ny * collision_map.resolution / PICTURE  # a pixel
        rows = ((np.arange(PICTURE) + 0.5) / PICTURE * ny).astype(int)
        width = max(1, round(nx * PICTURE / ny))
        columns = ((np.arange(width) + 0.5) / width * nx).astype(int)
        self._plan = np.ascontiguousarray(plan[columns][:, rows].transpose(1, 0, 2)[::-1])  # y up
        self._origin = np.asarray(collision_map.origin, np.float64) - 0.5 * collision_map.resolution
        v, u = np.mgrid[0:PICTURE, 0:width]
        self._x = self._origin[0] + (u + 0.5) * self._metres
        self._y = self._origin[1] + (PICTURE - v - 0.5) * self._metres
        self._paths: list[list[np.ndarray]] = [[] for _ in range(robots)]

    def forget(self, which: np.ndarray) -> None:
        """Clear the paths of the robots ``which``."""
        for i in which:
            self._paths[i] = []

    def draw(self, planar: np.ndarray, goals: np.ndarray, reach: float, radius: float) -> list[Panel]:
        """Draw one plan a robot, uint8 ``(360, width, 3)``."""
        plans = []
        for path, pose, goal in zip(self._paths, planar, goals, strict=True):
            path.append(pose[:2])
            del path[:-DRAWN_POSITIONS]
            picture = self._plan.copy()
            self._disc(picture, goal, reach, MAP_GOAL)
            for xy in path:
                self._disc(picture, xy, 0.03, MAP_PATH)
            self._disc(picture, pose[:2], radius, MAP_ROBOT)
            ahead = pose[:2] + radius * np.array([np.cos(pose[2]), np.sin(pose[2])])
            self._disc(picture, ahead, 0.5 * radius, MAP_ROBOT)
            plans.append(Panel(picture, "map", MAP_LEGEND))
        return plans

    def _disc(self, picture: np.ndarray, xy: np.ndarray, radius: float, colour: tuple[int, int, int]) -> None:
        picture[(self._x - xy[0]) ** 2 + (self._y - xy[1]) ** 2 <= max(radius, self._metres) ** 2] = colour
