"""Drive to a goal in an apartment that nobody has mapped: localise, map and plan at once (thesis 5.5.3).

``slam_nav`` knows its start pose and the goal in the start's frame, then sees RGB-D images only. PRISM estimates pose
and map; A* plans on the belief as it grows, with unknown space at a cost. Described in ``docs/agents/navigation.md``.
"""

from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.recovery import IN_OWN_MAP
from vssm_gym.agents.shared.surroundings import GrowingMap
from vssm_gym.agents.shared.trust import LostConfig
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.floor_plan import FloorPlan

# A robot that drives where it has seen nothing yet cannot do without its pose: it never coasts.
CONFIG = NavigationConfig(look_first=True, lost=LostConfig(coast=0, give_up=100), responses=IN_OWN_MAP)


class SlamNavAgent:
    """Localise against the map that it builds, plan in it."""

    name = "slam_nav"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = False

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        self._surroundings = GrowingMap(MapAndPose())
        self._navigator = Navigator(self._surroundings, config)
        self.reset, self.act = self._navigator.reset, self._navigator.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame; it is valid until the next step."""
        return self._surroundings.map

    @property
    def plan(self) -> FloorPlan:
        """Return the floor plan of the present belief, read from the map at each call."""
        return self._surroundings.floor_plan()
