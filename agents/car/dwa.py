"""Drive a car by the dynamic window approach on the learned map, with a horizon of one arc.

``dwa`` knows the distance to the target's position, not its heading: where a pose is asked it parks well by chance
only. Described in ``docs/agents/car.md``.
"""

import numpy as np

from vssm_gym.agents.shared.car.driver import SURFACE_ERROR, CarCommand, Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.dwa import DwaConfig, DwaState, DwaStatus, DynamicWindow
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.car.footprint_levels import FootprintLevels


class Window:
    """Control the car by a dynamic window, one goal after another."""

    def __init__(self, arena: Arena, car: Car, config: DwaConfig) -> None:
        self._car, self._config = car, config
        grid = arena.occupied, arena.origin, arena.resolution
        self._levels = FootprintLevels.from_occupied(*grid, car, margin=SURFACE_ERROR)
        self._window: DynamicWindow
        self._state: DwaState

    def begin(self, planar: np.ndarray, goal: np.ndarray, control: np.ndarray) -> str | None:
        """Compute distances to the target's position; return the reason where no path leads there."""
        self._window = DynamicWindow(self._levels, self._car, goal[:2], self._config)
        self._state = self._window.init()
        first = self._window.step(self._state, planar)
        return first.status.message if first.status is DwaStatus.NO_PATH else None

    def step(self, planar: np.ndarray) -> CarCommand:
        """Return the best arc within the window."""
        self._state = self._window.step(self._state, planar)
        return CarCommand(self._state.control, self._state.status.message)


class DwaAgent:
    """Drive by the dynamic window approach; the pose is observed."""

    name = "dwa"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self, config: DwaConfig | None = None) -> None:
        chosen = config or DwaConfig()
        driver = Driver(TruePose(), lambda arena, car: Window(arena, car, chosen))
        self.reset, self.act = driver.reset, driver.act
