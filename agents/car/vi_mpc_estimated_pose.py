"""Drive a car by value iteration and model-predictive control, with the pose tracked in the learned map.

``vi_mpc`` without the observed pose: the agent knows its start pose and then sees RGB-D images only. The motion prior
of the tracker is the car's arc. Described in ``docs/agents/car.md``.
"""

from vssm_gym.agents.car.vi_mpc import PROBLEM, ValueMpc
from vssm_gym.agents.shared.car.driver import Driver
from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.planning.mpc.random_search import RandomSearch


class ViMpcEstimatedPoseAgent:
    """Localise against the map; drive by value iteration and random search with an augmented Lagrangian."""

    name = "vi_mpc_estimated_pose"
    robot = "car"
    task = "pointgoal"
    needs_pose = False
    needs_map = True

    def __init__(self) -> None:
        solver = RandomSearch(PROBLEM)
        driver = Driver(FilteredPose("tracker"), lambda arena, car: ValueMpc(arena, car, solver))
        self.reset, self.act = driver.reset, driver.act
