"""Explore by frontiers with a full turn in every metre, with the pose estimated together with the map.

``frontier_gain_scan`` on ``q(M, z_t | x_<=t, u_<t)`` of PRISM, restricted to planar motion: the agent knows its start
pose and then sees RGB-D images only. It is the second baseline of ``mi_explorer_estimated_pose`` and does not value the
information that a view gives about the pose. Described in ``docs/agents/exploration.md``.
"""

from vssm_gym.agents.exploration.frontier_gain_scan import FrontierGainScan, FrontierGainScanConfig
from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.maps.voxel_map import VoxelMap


class FrontierGainScanEstimatedPoseAgent:
    """Explore frontiers by gain and cost with full turns on the path; map and pose are estimated together."""

    name = "frontier_gain_scan_estimated_pose"
    robot = "holonomic"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: FrontierGainScanConfig | None = None) -> None:
        self._explorer = Explorer(FrontierGainScan(config or FrontierGainScanConfig()), MapAndPose())
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
