"""Drive by the true pose and A* on the learned map: the upper bound of perfect localisation.

``oracle`` reads ``observation["pose"]``; map, planner and controller are those of ``astar``. Described in
``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.surroundings import KnownMap

# The pose is certain but for its rounding to float32, so the robot may stop 2 mm inside the success radius.
CONFIG = NavigationConfig(stop_margin=0.002)


class OracleAgent:
    """Read the true pose, plan in the map."""

    name = "oracle"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = True
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(KnownMap(TruePose()), config)
        self.reset, self.act = navigator.reset, navigator.act
