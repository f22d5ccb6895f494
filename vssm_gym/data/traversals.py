"""Drive through a maze as an operator would who sees it, and log the scans.

    next place = the middle of a tile that was visited least often, drawn among equals
    path       = the shortest one with room at its sides, along which the robot turns on the spot and drives

Tiles are those of the exploration ratio (:class:`~vssm_gym.envs.tasks.maze_objectives.MazeCoverage`).

The commands are executed with noise. The log's odometry is what was commanded: path integration is what a robot knows
that carries out its commands. Its poses are the true ones, for a judge.
"""

import math
from typing import Literal, overload

import numpy as np
from jaxtyping import Float

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.strip_logs import StripLog
from vssm_gym.envs.lidar_maze import LONGEST_RANGE, LidarMazeEnv
from vssm_gym.envs.robots import ExecutionNoise
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.sensors.lidar import LidarNoise
from vssm_gym.envs.sensors.maze_strip import StripNoise
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.envs.tasks.maze_objectives import TILE, MazeCoverage
from vssm_gym.envs.tasks.mazes import ROBOT, Maze
from vssm_gym.errors import InputError
from vssm_gym.geometry.planar_poses import relation
from vssm_gym.geometry.transforms import wrap_angle

SIDE_MARGINS = (0.02, 0.01, 0.005, 0.0)  # m at the robot's sides, tried in this order: the first that cuts off nothing
CORNER_REACHED = 0.02  # m from a corner or a place
DRIVES_WITHIN = math.radians(25.0)  # of the direction to the next corner; beyond it the robot turns on the spot
SLOWEST_LEG = 0.5  # of the longest step, of the slowest leg


class Operator:
    """Command a maze's robot from place to place.

    Args:
        maze: to drive in.
        seed: of the order and of the speed of each leg.
    """

    def __init__(self, maze: Maze, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        tiles = np.argwhere(MazeCoverage(maze.space).counted)
        self._space = _roomy(maze.space)
        self._places = np.array([self._space.nearest(middle) for middle in TILE * (tiles + 0.5)])
        self._geodesics = Geodesics(self._space)
        self._number = {tuple(tile): i for i, tile in enumerate(tiles.tolist())}
        self._visits, self._tile = np.zeros(len(tiles), int), (-1, -1)
        self._corners: list[np.ndarray] = []
        self._limits, self._speed = ROBOT.limits, 1.0

    def __call__(self, planar: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the next action ``(turn, s, stop)`` at a true pose x, y (m), heading (rad)."""
        self._count(planar[:2])
        while self._corners and np.hypot(*(self._corners[0] - planar[:2])) < CORNER_REACHED:
            self._corners.pop(0)
        if not self._corners:
            self._corners = self._next_leg(planar[:2])
        away = self._corners[0] - planar[:2]
        turn = float(wrap_angle(math.atan2(away[1], away[0]) - planar[2]))
        most_turn, _, most_step = self._limits
        step = min(self._speed * most_step, math.hypot(*away)) if abs(turn) < DRIVES_WITHIN else 0.0
        return np.array([np.clip(turn, -most_turn, most_turn), step, 0.0])

    def _count(self, xy: np.ndarray) -> None:
        """Count a visit where the robot comes to another tile."""
        x, y = np.floor(xy / TILE).astype(int).tolist()
        if (x, y) != self._tile and (x, y) in self._number:
            self._visits[self._number[x, y]] += 1
        self._tile = x, y

    def _next_leg(self, xy: np.ndarray) -> list[np.ndarray]:
        """Return the corners of the path to the next place, the place last."""
        least = np.flatnonzero(self._visits == self._visits.min())
        chosen = least[self._rng.integers(len(least))]
        self._visits[chosen] += 1  # also where the place nearest to the middle lies in another tile
        place = self._places[chosen]
        self._speed = float(self._rng.uniform(SLOWEST_LEG, 1.0))
        return [*self._geodesics.path(self._space.nearest(xy), place)[1:]] or [place]


@overload
def traverse(
    maze: Maze,
    steps: int,
    seed: int = 0,
    noise: str | ExecutionNoise = "low",
    sensor_noise: str | LidarNoise = "low",
    beams: int = 64,
    sensor: Literal["lidar"] = "lidar",
) -> LaserLog: ...


@overload
def traverse(
    maze: Maze,
    steps: int,
    seed: int = 0,
    noise: str | ExecutionNoise = "low",
    sensor_noise: str | StripNoise = "low",
    beams: int = 64,
    *,
    sensor: Literal["camera"],
) -> StripLog: ...


def traverse(
    maze: Maze,
    steps: int,
    seed: int = 0,
    noise: str | ExecutionNoise = "low",
    sensor_noise: str | LidarNoise | StripNoise = "low",
    beams: int = 64,
    sensor: Literal["lidar", "camera"] = "lidar",
) -> LaserLog | StripLog:
    """Log a traversal: a scan or a strip before each of ``steps`` commands and one after the last.

    The drive is the same for both sensors.

    Args:
        maze: to drive in.
        steps: commands.
        seed: of the operator and of the noise; it begins at a place of the grid that it draws.
        noise: of the execution.
        sensor_noise: of the ranges or pixels.
        beams: readings a scan, or columns a strip.
        sensor: ``lidar`` or ``camera``.

    Raises:
        InputError: no steps, or a sensor or noise that the environment refuses.
    """
    if steps < 1:
        raise InputError("traverse", "steps", f"at least 1, not {steps}")
    env = LidarMazeEnv(maze.apartment, noise=noise, sensor_noise=sensor_noise, beams=beams, sensor=sensor)
    key = "strip" if sensor == "camera" else "scan"
    observation, _ = env.reset(seed=seed)
    operator = Operator(maze, seed)
    readings, poses, motions = [observation[key]], [env.planar], []
    for _ in range(steps):
        observation, _, _, _, info = env.step(operator(env.planar))
        turn, step = info["control"]
        motions.append((step, 0.0, turn))  # along the heading before the turn
        readings.append(observation[key])
        poses.append(env.planar)
    env.close()
    angles = 2.0 * np.pi * np.arange(beams) / beams
    if sensor == "camera":
        return StripLog(np.concatenate(readings), angles, np.array(motions), np.array(poses))
    none = np.zeros((0, 3))
    return LaserLog(
        np.array(readings, np.float32), angles, LONGEST_RANGE, np.zeros(3), np.array(motions), np.array(poses),
        np.zeros((0, 2), int), none,
    )  # fmt: skip


def errors(log: LaserLog | StripLog, estimated: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, "scans"]:
    """Return the distance of each estimated position to the log's, m, both seen from the first pose."""
    assert log.poses is not None
    seen = lambda poses: relation(poses[:1], poses)[:, :2]
    return np.hypot(*(seen(estimated) - seen(log.poses)).T)


def _roomy(space: FreeSpace) -> FreeSpace:
    """Return the space with the widest margin that leaves it in one part."""
    for margin in SIDE_MARGINS:
        try:
            found = space.widened(margin)
        except InputError:
            continue
        if len(found.region.geoms) == 1:
            return found
    return space
