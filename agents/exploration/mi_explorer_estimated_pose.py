"""Explore by mutual information, with the pose estimated together with the map.

``mi_explorer`` on ``q(M, z_t | x_<=t, u_<t)`` of PRISM, restricted to planar motion: the agent knows its start pose and
then sees RGB-D images only. The information of a view about the pose, ``1/2 log det(I + S F)``, is added to its
information about the map. Described in ``docs/agents/exploration.md``.
"""

from vssm_gym.agents.exploration.mi_explorer import MiExplorerConfig, MutualInformation, Tour
from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.maps.voxel_map import VoxelMap


class MiExplorerEstimatedPoseAgent:
    """Explore by mutual information; map and pose are estimated together."""

    name = "mi_explorer_estimated_pose"
    robot = "holonomic"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: MiExplorerConfig | None = None) -> None:
        self._strategy = MutualInformation(config or MiExplorerConfig())
        self._explorer = Explorer(self._strategy, MapAndPose())
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def tour(self) -> Tour | None:
        """Return the gains from which the last viewpoint was chosen; None before the first choice."""
        return self._strategy.tour

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
