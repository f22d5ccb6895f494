"""Explore a maze by the nearest frontier of what is known of it (Yamauchi 1997), with the pose estimated from scans.

    goal = argmin_f d(f)        d: path length to the place nearest to the middle of frontier f that can be reached

``maze_frontier`` has the pose filter, the maps and the driving of ``maze_information``; where nothing is left it stays
where it is. Described in ``docs/agents/exploration.md``.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.planar.driving import follow_safely, leave
from vssm_gym.agents.shared.planar.scan_mapper import ScanMapper, ScanMapperConfig
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.planning.exploration.frontier import frontiers
from vssm_gym.planning.exploration.plane.roads import PlaneRoads
from vssm_gym.planning.occupancy_grid import UNKNOWN


@dataclass(frozen=True)
class MazeFrontierConfig:
    """Configure ``maze_frontier``; lengths in metres."""

    mapper: ScanMapperConfig = field(default_factory=ScanMapperConfig)
    room: float = 0.02  # around the robot's centre that a path keeps
    margin: float = 0.001  # beyond the robot's radius that must be free ahead
    near: float = 0.03  # of a frontier that the robot can come to
    length: float = 0.1  # of a piece of a long frontier
    executed: int = 10  # steps towards a frontier before the nearest one is found again
    given_up: float = 0.03  # around the goal of a frontier that stays after it was visited


class MazeFrontierAgent:
    """Drive to the nearest frontier, again and again."""

    name = "maze_frontier"
    robot = "disc"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: MazeFrontierConfig | None = None) -> None:
        self._config = config or MazeFrontierConfig()
        self._mapper = ScanMapper(self._config.mapper)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; nothing is random."""
        del seed
        self._mapper.reset(context, observation)
        self._limits = np.asarray(context.limits, np.float64)
        self._half_width = 0.5 * context.body_length + self._config.margin
        self._last: np.ndarray | None = None
        self._path: np.ndarray | None = None
        self._driven = 0
        self._visited: list[np.ndarray] = []  # goals that were reached, m

    def act(self, observation: Observation) -> Decision:
        """Update pose and map, find the nearest frontier where it is due, and drive a step."""
        began = time.perf_counter()
        if self._last is not None:
            self._mapper.observe(self._last, observation)
        pose, scan = self._mapper.pose, self._mapper.smooth_scan()
        tracked = time.perf_counter()
        command = self._continue(pose, scan)
        latency, status = {"tracking": tracked - began}, "to a frontier"
        if command is None:
            self._path, self._driven = self._nearest(pose), 0
            command = self._continue(pose, scan)
            latency["planning"] = time.perf_counter() - tracked
        if self._path is None:
            command, status = np.zeros(2), "nothing is left"
        elif command is None:
            command, status = leave(scan, self._limits, self._half_width), "leaves a tight place"
        self._last, self._driven = command, self._driven + 1
        action = np.array([*command, 0.0], np.float32)
        covariance = np.asarray(self._mapper.belief.covariance, np.float64)
        return Decision(action, pose, status, latency, self._path, covariance=covariance)

    @property
    def planar_map(self) -> PlanarMap:
        """Return what is known of the maze."""
        return self._mapper.map

    def _continue(self, pose: np.ndarray, scan: np.ndarray) -> np.ndarray | None:
        """Return the next command of the present path; None where it is over, or the way is not free."""
        if self._path is None or self._driven >= self._config.executed:
            return None
        command = follow_safely(pose, self._path, scan, self._limits, self._half_width)
        if command is None:
            self._visited.append(self._path[-1])
        return command

    def _nearest(self, pose: np.ndarray) -> np.ndarray | None:
        """Return the path to the nearest frontier of what is known, through all that was seen to be free."""
        c = self._config
        roads = PlaneRoads.of(self._mapper.seen, pose[:2], c.room)
        cells = np.where(self._mapper.map.observed, roads.plan.cells, UNKNOWN).astype(np.int8)
        plan = replace(roads.plan, cells=cells)
        visited = np.reshape(self._visited, (-1, 2))
        for found in frontiers(plan, roads.distance, near=c.near, length=c.length):
            gap = np.linalg.norm(visited - found.goal, axis=1).min(initial=np.inf)
            if gap > c.given_up:
                path = roads.path_to(found.goal)
                if len(path) > 1:
                    return path
        return None
