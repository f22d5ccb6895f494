"""Plan by hybrid A* in a learned model of laser scans, and localise in it by particles (DVBF-LM, "ours").

``scan_astar`` reads scans, its own commands and the model, never the true pose. Described in
``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.scans.localization import ParticlePose
from vssm_gym.agents.shared.scans.navigator import ScanNavigation, ScanNavigator

CONFIG = ScanNavigation()


class ScanAStarAgent:
    """Filter the pose in the model, plan in the model."""

    name = "scan_astar"
    robot = "disc"
    task = "pointgoal"
    needs_pose = False
    needs_map = True

    def __init__(self, config: ScanNavigation = CONFIG) -> None:
        navigator = ScanNavigator(ParticlePose(config.particles), config)
        self.reset, self.act = navigator.reset, navigator.act
