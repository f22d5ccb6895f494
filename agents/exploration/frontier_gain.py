"""Explore by the frontier with most unknown area in sight for its path length (Gonzalez-Banos and Latombe 2002).

``frontier_gain`` reads the true pose; its choice is that of :mod:`vssm_gym.agents.shared.frontier_gain`. Described in
``docs/agents/exploration.md``.
"""

from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.maps.voxel_map import VoxelMap


class FrontierGainAgent:
    """Explore frontiers by gain and cost; the pose is observed."""

    name = "frontier_gain"
    robot = "holonomic"
    task = "explore"
    needs_pose = True
    needs_map = False

    def __init__(self, config: FrontierGainConfig | None = None) -> None:
        self._explorer = Explorer(FrontierGain(config or FrontierGainConfig()))
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
