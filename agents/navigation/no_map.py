"""Align each image to the one before, and plan with A* on the learned map (TNP-SM, "no map").

``no_map`` plans in the same map as ``astar`` but never compares an image with it, so its errors add up. Described in
``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.recovery import WITHOUT_IMAGES
from vssm_gym.agents.shared.surroundings import KnownMap

CONFIG = NavigationConfig(responses=WITHOUT_IMAGES)


class NoMapAgent:
    """Localise against the previous image, plan in the map."""

    name = "no_map"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(KnownMap(FilteredPose("frames")), config)
        self.reset, self.act = navigator.reset, navigator.act
