"""Plan by hybrid A* in a latent grid, and localise in it by particles: navigation in DVBF-LM's own map.

``scan_astar_latent`` is ``scan_astar`` with charts in the place of the occupancy map. Described in
``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.scans.localization import ParticlePose
from vssm_gym.agents.shared.scans.navigator import ScanNavigation, ScanNavigator

CONFIG = ScanNavigation()


class ScanAStarLatentAgent:
    """Filter the pose in the charts, plan in the charts."""

    name = "scan_astar_latent"
    robot = "disc"
    task = "pointgoal"
    needs_pose = False
    needs_map = True
    needs_latent_map = True  # context.scan_model predicts the ranges of a latent grid

    def __init__(self, config: ScanNavigation = CONFIG) -> None:
        navigator = ScanNavigator(ParticlePose(config.particles), config)
        self.reset, self.act = navigator.reset, navigator.act
