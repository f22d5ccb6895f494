"""``vi_mpc_tracked``: ``vi_mpc`` that is told its start and from then on sees RGB-D images only.

The pose is tracked against the learned map, with the car's arc as prior.
"""

from vssm_gym.agents.car.vi_mpc import PROBLEM, ValueMpc
from vssm_gym.agents.shared.driver import Driver
from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.planning.mpc.random_search import RandomSearch


class ViMpcTrackedAgent:
    """Localises against the map; value iteration and random search with an augmented Lagrangian."""

    name = "vi_mpc_tracked"
    robot = "car"
    task = "pointgoal"
    needs_pose = False
    needs_map = True

    def __init__(self) -> None:
        solver = RandomSearch(PROBLEM)
        driver = Driver(FilteredPose("tracker"), lambda arena, car: ValueMpc(arena, car, solver))
        self.reset, self.act = driver.reset, driver.act
