"""Plan by hybrid A* on the true map, at the true pose: the bound of ``scan_astar``.

``scan_oracle`` reads ``observation["pose"]``, and the model in its context predicts the simulator's own ranges; planner
and follower are those of ``scan_astar``. Described in ``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.scans.localization import ObservedPose
from vssm_gym.agents.shared.scans.navigator import ScanNavigation, ScanNavigator

CONFIG = ScanNavigation()


class ScanOracleAgent:
    """Read the true pose, plan on the true map."""

    name = "scan_oracle"
    robot = "disc"
    task = "pointgoal"
    needs_pose = True
    needs_map = False
    needs_true_map = True  # context.scan_model predicts the true ranges

    def __init__(self, config: ScanNavigation = CONFIG) -> None:
        navigator = ScanNavigator(ObservedPose(), config)
        self.reset, self.act = navigator.reset, navigator.act
