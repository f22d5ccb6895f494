"""``dwa``: the dynamic window approach on the learned map: looks two seconds ahead and no further.

Knows the distance to the target's position, not its heading: where a pose is asked it parks well by chance only.
"""

import numpy as np

from vssm_gym.agents.shared.driver import CarCommand, Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.dwa import DwaState, DwaStatus, DynamicWindow
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.car.footprint_levels import FootprintLevels

MARGIN = 0.01  # m around the footprint


class Window:
    """:class:`~vssm_gym.agents.shared.driver.CarController`: the dynamic window, one goal after another."""

    def __init__(self, arena: Arena, car: Car) -> None:
        self._car = car
        grid = arena.occupied, arena.origin, arena.resolution
        self._levels = FootprintLevels.from_occupied(*grid, car, margin=MARGIN)
        self._window: DynamicWindow
        self._state: DwaState

    def begin(self, planar: np.ndarray, goal: np.ndarray, control: np.ndarray) -> str | None:
        """Distances to the target's position; the reason where none leads from here."""
        self._window = DynamicWindow(self._levels, self._car, goal[:2])
        self._state = self._window.init()
        first = self._window.step(self._state, planar)
        return first.status.message if first.status is DwaStatus.NO_PATH else None

    def step(self, planar: np.ndarray) -> CarCommand:
        """The best arc within reach."""
        self._state = self._window.step(self._state, planar)
        return CarCommand(self._state.control, self._state.status.message)


class DwaAgent:
    """The dynamic window approach; the pose is observed."""

    name = "dwa"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self) -> None:
        driver = Driver(TruePose(), Window)
        self.reset, self.act = driver.reset, driver.act
