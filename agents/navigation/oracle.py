"""``oracle``: the true pose, and A* on the learned map: what perfect localisation would reach.

The only agent that reads ``observation["pose"]``; map, planner and controller are those of ``astar``.
"""

from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.agents.shared.navigator import NavigationConfig, Navigator

# The pose is certain but for its rounding to float32, so it stops at the very rim.
CONFIG = NavigationConfig(stop_margin=0.002)


class OracleAgent:
    """Knows the true pose, plans in the map."""

    name = "oracle"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = True
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(TruePose(), config)
        self.reset, self.act = navigator.reset, navigator.act
