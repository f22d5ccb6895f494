"""Provide what a navigator plans in: a map that it was given, or one that it builds as it drives.

A :class:`Surroundings` localises the robot and says where it can drive. The navigator
(:mod:`vssm_gym.agents.shared.navigator`) is the same for both.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.agents.shared.localization import Localization, Localizer
from vssm_gym.agents.shared.mapping import Mapper
from vssm_gym.agents.shared.own_map import READ, OwnMap, OwnMapConfig
from vssm_gym.errors import InputError
from vssm_gym.maps.columns import BODY_HEIGHTS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.floor_plan import FloorPlan, changed_cells
from vssm_gym.planning.traversability import Body, TraversabilityConfig, of_clearance, of_plan

TRAVERSABILITY, OWN_MAP = TraversabilityConfig(), OwnMapConfig()
NEAR = 1.2  # m around the robot within which steps are tested


@dataclass(frozen=True)
class Terrain:
    """Hold where the robot can drive, as it is known now.

    Attributes:
        space: that paths are planned in, with weights; unknown space may be free at a cost.
        near: clearance around the robot; unknown space is not free.
        changed: ``(n, 2)`` places, m, whose state has changed since the last look.
        plan: the floor plan of the belief; None where the map was given.
    """

    space: ClearanceMap
    near: ClearanceMap
    changed: np.ndarray
    plan: FloorPlan | None = None


class Surroundings(Protocol):
    """Localise the robot and look where it can drive."""

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, valid until the next observation."""
        ...

    @property
    def is_full(self) -> bool:
        """Return True where something was seen that the map had no storage left for."""
        ...

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Begin at ``context.start_pose``, from where ``observation`` was seen."""
        ...

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Return the belief over the pose after ``command``, which ``observation`` followed."""
        ...

    def look(self, planar: np.ndarray, goal: np.ndarray) -> Terrain:
        """Return where a robot at ``planar`` can drive on its way to ``goal`` ``(2,)``, m."""
        ...

    def around(self, planar: np.ndarray) -> ClearanceMap:
        """Return the clearance around ``planar``, without a look: what has changed since the last one stays so."""
        ...

    def sees_ahead(self) -> bool:
        """Return True where the map was given, or the last image shows what the robot has in front of it."""
        ...

    def meet(self, xy: np.ndarray, radius: float) -> None:
        """Remember an obstacle that the map does not show: a disc at ``xy``, m."""
        ...

    def doubt(self, xy: np.ndarray, radius: float) -> bool:
        """Forget obstacles within ``radius`` of ``xy`` (m) that were met or seen from nearby; False where none were."""
        ...


class KnownMap:
    """Plan in the learned map of the context, which does not change; its clearance is computed once per map."""

    def __init__(
        self,
        localizer: Localizer,
        traversability: TraversabilityConfig = TRAVERSABILITY,
        heights: tuple[float, float] = BODY_HEIGHTS,
        resolution: float = 0.025,
    ) -> None:
        self._localizer, self._traversability = localizer, traversability
        self._heights, self._resolution = heights, resolution
        self._map: VoxelMap | None = None
        self._clearance: ClearanceMap  # of that map, kept over episodes
        self._static: ClearanceMap  # the same with the weights of this episode's robot

    @property
    def map(self) -> VoxelMap:
        """Return the learned map."""
        assert self._map is not None
        return self._map

    @property
    def is_full(self) -> bool:
        """Return False: nothing is added to the map."""
        return False

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Start the localizer; raise :class:`InputError` without a map."""
        if context.map is None:
            raise InputError("AgentContext", "map", "a learned map: this agent plans in one")
        if context.map is not self._map:
            static = ClearanceMap.from_voxel_map(context.map, *self._heights, self._resolution)
            self._clearance, self._map = static, context.map
        self._static = of_clearance(self._clearance, _body(context), self._traversability)
        self._space = self._static
        return self._localizer.reset(context, observation)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Run the localizer."""
        return self._localizer.update(command, observation)

    def look(self, planar: np.ndarray, goal: np.ndarray) -> Terrain:
        """Return the map's clearance with the obstacles that were met."""
        return Terrain(self._space, self._space, np.empty((0, 2)))

    def around(self, planar: np.ndarray) -> ClearanceMap:
        """Return the map's clearance with the obstacles that were met."""
        return self._space

    def sees_ahead(self) -> bool:
        """Return True: the map was learned before."""
        return True

    def meet(self, xy: np.ndarray, radius: float) -> None:
        """Add a disc to the clearance until the episode's end, or until it is doubted."""
        self._space = self._space.with_obstacle(xy, radius)

    def doubt(self, xy: np.ndarray, radius: float) -> bool:
        """Forget all discs: few are ever met."""
        met, self._space = self._space is not self._static, self._static
        return met


class GrowingMap:
    """Plan in the map that a mapper builds as the robot drives."""

    def __init__(
        self,
        mapper: Mapper,
        traversability: TraversabilityConfig = TRAVERSABILITY,
        own: OwnMapConfig = OWN_MAP,
    ) -> None:
        self._mapper, self._traversability, self._own_config = mapper, traversability, own
        self._own: OwnMap

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment."""
        return self._own.map

    @property
    def is_full(self) -> bool:
        """Return True where something was seen that the map had no storage left for."""
        return self._own.is_full

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Begin an empty map with the first image."""
        self._body = _body(context)
        self._own = OwnMap(context, self._mapper, self._own_config, observation)
        self._last: FloorPlan | None = None
        self._depth = np.asarray(observation["depth"])
        return self._own.estimate

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Filter pose and map."""
        self._own.take(command, observation)
        self._depth = np.asarray(observation["depth"])
        return self._own.estimate

    def look(self, planar: np.ndarray, goal: np.ndarray) -> Terrain:
        """Read the floor plan of the belief, and where it differs from the last one."""
        plan = self._own.plan(keep=np.stack([planar[:2], goal]))
        changed = np.empty((0, 2)) if self._last is None else plan.centres(changed_cells(self._last, plan))
        self._last = plan
        space = of_plan(plan, goal, self._body, self._traversability)
        return Terrain(space, plan.clearance(planar[:2], NEAR), changed, plan)

    def around(self, planar: np.ndarray) -> ClearanceMap:
        """Read the floor plan around the robot."""
        return self._own.plan(keep=planar[None, :2]).clearance(planar[:2], NEAR)

    def floor_plan(self) -> FloorPlan:
        """Read the floor plan of the belief; the next look is not affected."""
        return self._own.plan()

    def sees_ahead(self) -> bool:
        """Return True unless the middle of the last image has next to no depth, as before a wall too near to see."""
        rows, columns = self._depth.shape
        middle = self._depth[rows // 3 :, columns // 3 : columns - columns // 3]
        return float(np.mean(np.isfinite(middle) & (middle > 0.0))) >= READ

    def meet(self, xy: np.ndarray, radius: float) -> None:
        """Mark the columns of a disc as occupied."""
        self._own.meet(xy, max(radius, 0.75 * self._own_config.voxel))

    def doubt(self, xy: np.ndarray, radius: float) -> bool:
        """Forget what was seen at the body's height from nearby, and what was met."""
        return self._own.doubt(xy, radius)


def _body(context: AgentContext) -> Body:
    return Body(0.5 * context.body_length, context.noise[1])
