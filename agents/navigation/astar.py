"""``astar``: track the pose in the learned map, plan with A* on it, drive (TNP-SM, "ours").

Reads RGB-D, its own commands and the map; never the true pose.
"""

from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.agents.shared.navigator import NavigationConfig, Navigator

CONFIG = NavigationConfig()


class AStarAgent:
    """Localises against the map, plans in the map."""

    name = "astar"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(FilteredPose("tracker"), config)
        self.reset, self.act = navigator.reset, navigator.act
