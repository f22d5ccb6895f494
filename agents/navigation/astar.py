"""Track the pose in the learned map, plan with A* on it, and drive (TNP-SM, "ours").

``astar`` reads RGB-D, its own commands and the map, never the true pose. Described in ``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.surroundings import KnownMap

CONFIG = NavigationConfig()


class AStarAgent:
    """Localise against the map, plan in the map."""

    name = "astar"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(KnownMap(FilteredPose("tracker")), config)
        self.reset, self.act = navigator.reset, navigator.act
