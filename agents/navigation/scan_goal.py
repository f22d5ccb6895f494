"""Drive to where a scan was taken: the likeliest pose that explains it is the goal (DVBF-LM, section VI-A).

``scan_goal`` reads scans, the scan of its goal, its own commands, the model and its encoder. It drives as
``scan_astar`` does, and its first stop ends the episode. Described in ``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.scans.goal_by_scan import GoalByScan
from vssm_gym.agents.shared.scans.navigator import ScanNavigation

CONFIG = ScanNavigation()


class ScanGoalAgent:
    """Stop where the goal's scan is explained best."""

    name = "scan_goal"
    robot = "disc"
    task = "pointgoal"
    needs_pose = False
    needs_map = True
    goal_by_scan = True  # observation["goal_scan"] in the place of observation["goal"]

    def __init__(self, config: ScanNavigation = CONFIG) -> None:
        seeker = GoalByScan(config)
        self.reset, self.act = seeker.reset, seeker.act
