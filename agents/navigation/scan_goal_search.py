"""Drive to all places that explain a scan, the likeliest first, until the episode ends.

``scan_goal_search`` is ``scan_goal`` where the environment says when the goal is reached (``end_on="reach"``): which of
two places that look alike was meant, no scan says. Described in ``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.scans.goal_by_scan import GoalByScan
from vssm_gym.agents.shared.scans.navigator import ScanNavigation

CONFIG = ScanNavigation()


class ScanGoalSearchAgent:
    """Go on to the next place that explains the goal's scan where a stop ends nothing."""

    name = "scan_goal_search"
    robot = "disc"
    task = "pointgoal"
    needs_pose = False
    needs_map = True
    goal_by_scan = True  # observation["goal_scan"] in the place of observation["goal"]
    end_on = "reach"  # of its episodes

    def __init__(self, config: ScanNavigation = CONFIG) -> None:
        seeker = GoalByScan(config)
        self.reset, self.act = seeker.reset, seeker.act
