"""Drive a car by the critic of ``vi_mpc`` and path-integral control (MPPI) as actor.

Described in ``docs/agents/car.md``.
"""

from vssm_gym.agents.car.vi_mpc import PROBLEM, ValueMpc
from vssm_gym.agents.shared.car.driver import Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.planning.mpc.mppi import Mppi


class ViMppiAgent:
    """Drive by value iteration and path-integral control (MPPI); the pose is observed."""

    name = "vi_mppi"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self) -> None:
        solver = Mppi(PROBLEM)
        driver = Driver(TruePose(), lambda arena, car: ValueMpc(arena, car, solver))
        self.reset, self.act = driver.reset, driver.act
