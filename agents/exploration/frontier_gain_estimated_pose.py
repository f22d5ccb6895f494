"""Explore by the frontier of greatest utility, with the pose estimated together with the map.

``frontier_gain`` on ``q(M, z_t | x_<=t, u_<t)`` of PRISM, restricted to planar motion: the agent knows its start pose
and then sees RGB-D images only. It is the baseline of ``mi_explorer_estimated_pose`` and does not value the information
that a view gives about the pose. Described in ``docs/agents/exploration.md``.
"""

from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.maps.voxel_map import VoxelMap


class FrontierGainEstimatedPoseAgent:
    """Explore frontiers by gain and cost; map and pose are estimated together."""

    name = "frontier_gain_estimated_pose"
    robot = "holonomic"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: FrontierGainConfig | None = None) -> None:
        self._explorer = Explorer(FrontierGain(config or FrontierGainConfig()), MapAndPose())
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
