"""Plan by Hybrid A* with Reeds-Shepp curves on the learned map, then follow the drive by pure pursuit.

``hybrid_astar`` plans once per target, and again where the car has left its plan or ended beside the target. It reads
the true pose. Described in ``docs/agents/car.md``.
"""

import itertools
import math
from dataclasses import dataclass, field

import numpy as np

from vssm_gym.agents.shared.car.driver import CarCommand, Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.car.footprint_levels import FootprintLevels
from vssm_gym.planning.car.hybrid_astar import CarPlan, HybridAStarConfig, plan
from vssm_gym.planning.car.pursuit import CarPath, PursuitConfig
from vssm_gym.planning.result import PlanStatus


@dataclass(frozen=True)
class HybridPursuitConfig:
    """Configure when and where to the car plans, how it searches, and how it follows.

    Args:
        expansions: of a search: a count, not a time, so that runs repeat exactly on any machine.
        margins: m around the footprint, tried in turn: with room for an error of the map, then without.
        astray: distance from the plan at which the car plans again, m.
        turned: angle off the plan's heading at which the car plans again, rad.
        offset: m and rad along x, y and heading, by which poses around the target differ from it. They lie inside its
            region; in a map rounded to cells the car may fit at one only.
        search: costs and resolution of hybrid A*.
        pursuit: how the drive is followed.
    """

    expansions: int = 300_000
    margins: tuple[float, ...] = (0.02, 0.0)
    astray: float = 0.08
    turned: float = 0.4
    offset: tuple[float, float, float] = (0.04, 0.04, 0.1)
    search: HybridAStarConfig = field(default_factory=HybridAStarConfig)
    pursuit: PursuitConfig = field(default_factory=PursuitConfig)


class HybridPursuit:
    """Plan a drive, follow it, and plan again where that fails."""

    def __init__(self, arena: Arena, car: Car, config: HybridPursuitConfig) -> None:
        grid = arena.occupied, arena.origin, arena.resolution
        self._car, self._config, self._progress = car, config, 0.0
        around = itertools.product(*((-step, 0.0, step) for step in config.offset))
        self._offsets = np.array([[0.0, 0.0, 0.0], *around])
        self._levels = [FootprintLevels.from_occupied(*grid, car, margin=margin) for margin in config.margins]

    def begin(self, planar: np.ndarray, goal: np.ndarray, control: np.ndarray) -> str | None:
        """Plan; return the planner's reason where it finds no drive."""
        self._goal = goal
        result = self._plan(planar)
        return None if result.found else result.status.message

    def step(self, planar: np.ndarray) -> CarCommand:
        """Follow the drive, after a new plan where the car left the old one or ended elsewhere."""
        following = self._drive.follow(planar, self._progress, self._car)
        turned = abs(following.heading_error) > self._config.turned
        astray = following.deviation > self._config.astray or turned
        if following.done or astray:
            result = self._plan(planar)
            if not result.found:
                return CarCommand(np.zeros(2), f"stands: {result.status.message}")
            following = self._drive.follow(planar, 0.0, self._car)
        self._progress = following.progress
        return CarCommand(following.control, "follows its drive", self._drive.poses[:, :2])

    def _plan(self, planar: np.ndarray) -> CarPlan:
        """Return the first drive found: to the target with a margin, without one, then to poses around it."""
        c = self._config
        for goal in self._goal + self._offsets[:, : len(self._goal)]:
            for levels in self._levels:
                result = plan(
                    planar, goal, levels, self._car, config=c.search, time_limit=math.inf, max_expansions=c.expansions
                )
                if result.found:
                    self._drive, self._progress = CarPath(result.poses, result.gears, c.pursuit), 0.0
                    return result
            if result.status is not PlanStatus.GOAL_BLOCKED:
                return result
        return result


class HybridAStarAgent:
    """Drive by Hybrid A* and pure pursuit; the pose is observed."""

    name = "hybrid_astar"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self, config: HybridPursuitConfig | None = None) -> None:
        chosen = config or HybridPursuitConfig()
        driver = Driver(TruePose(), lambda arena, car: HybridPursuit(arena, car, chosen))
        self.reset, self.act = driver.reset, driver.act
