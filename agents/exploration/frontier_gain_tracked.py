"""``frontier_gain_tracked``: ``frontier_gain`` that is told its start and from then on sees RGB-D images only (SPEC 8).

``q(M, z_t | x_<=t, u_<t)`` is PRISM's on the floor. The baseline of ``mi_explorer_tracked``: it does not ask what a
view would tell of its pose.
"""

from vssm_gym.agents.exploration.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.maps.voxel_map import VoxelMap


class FrontierGainTrackedAgent:
    """Frontier exploration by gain and cost; map and pose are estimated together."""

    name = "frontier_gain_tracked"
    robot = "holonomic"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: FrontierGainConfig | None = None) -> None:
        self._explorer = Explorer(FrontierGain(config or FrontierGainConfig()), MapAndPose())
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """The belief over the apartment, world frame."""
        return self._explorer.map
