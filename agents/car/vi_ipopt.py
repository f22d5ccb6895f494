"""Drive a car by the critic of ``vi_mpc`` and an interior-point method (CasADi, IPOPT) as actor.

Described in ``docs/agents/car.md``.
"""

from vssm_gym.agents.car.vi_mpc import PROBLEM, ValueMpc
from vssm_gym.agents.shared.car.driver import Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.planning.mpc.ipopt import Ipopt


class ViIpoptAgent:
    """Drive by value iteration and an interior-point method (CasADi, IPOPT); the pose is observed."""

    name = "vi_ipopt"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self) -> None:
        solver = Ipopt(PROBLEM)
        driver = Driver(TruePose(), lambda arena, car: ValueMpc(arena, car, solver))
        self.reset, self.act = driver.reset, driver.act
