"""``frontier_looking_tracked``: ``frontier_looking`` that is told its start and then sees RGB-D images only (SPEC 8).

``q(M, z_t | x_<=t, u_<t)`` is PRISM's on the floor. The second baseline of ``mi_explorer_tracked``: it looks aside on
its way too, and does not ask what a view would tell of its pose.
"""

from vssm_gym.agents.exploration.frontier_looking import FrontierLookingConfig, LookingFrontier
from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.maps.voxel_map import VoxelMap


class FrontierLookingTrackedAgent:
    """Frontier exploration by gain and cost with turns on the way; map and pose are estimated together."""

    name = "frontier_looking_tracked"
    robot = "holonomic"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: FrontierLookingConfig | None = None) -> None:
        self._explorer = Explorer(LookingFrontier(config or FrontierLookingConfig()), MapAndPose())
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """The belief over the apartment, world frame."""
        return self._explorer.map
