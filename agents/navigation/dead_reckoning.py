"""Integrate the commands, and plan with A* on the learned map (TNP-SM, "dynamics").

``dead_reckoning`` plans in the same map as ``astar`` and reads no image. Described in ``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.recovery import WITHOUT_IMAGES
from vssm_gym.agents.shared.surroundings import KnownMap

CONFIG = NavigationConfig(responses=WITHOUT_IMAGES)


class DeadReckoningAgent:
    """Localise by the own commands, plan in the map."""

    name = "dead_reckoning"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(KnownMap(FilteredPose("dead_reckoning")), config)
        self.reset, self.act = navigator.reset, navigator.act
