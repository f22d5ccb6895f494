"""Weigh where a robot should drive: ``w = 1 + a (1 - spare / comfort)^2 + u [unknown] + ...`` (eq. P2c).

The clearance says where a body fits. The weight, a cost a metre, says where it had better not go although it fits: close
to obstacles, where there is room elsewhere, and through space that nobody has seen. Unknown space is crossed at a cost,
so that a robot drives towards a goal that it cannot see yet; with an infinite cost it is as good as occupied.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.maps.columns import near_level_distance
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration.building_prior import outline
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import OCCUPIED, UNKNOWN

REACH = 0.7  # m, up to which clearances in a growing map are computed; no robot asks for more


@dataclass(frozen=True)
class TraversabilityConfig:
    """Configure what a metre costs beyond its length.

    Attributes:
        comfort: m of clearance beyond the body's radius from which on nothing is gained by more.
        nearness: added where the body just fits; it falls with the square towards ``comfort``.
        unknown: added in unknown space: 0 is the optimist who expects nothing there; infinity never enters.
        outside: factor of ``unknown`` beyond the rectangle around all that is known and the goal.
    """

    comfort: float = 0.15
    nearness: float = 0.6
    unknown: float = 0.4
    outside: float = 3.0

    def __post_init__(self) -> None:
        for name in ("comfort", "nearness", "unknown", "outside"):
            value = getattr(self, name)
            if not value >= 0.0 or (name != "unknown" and math.isinf(value)):
                raise InputError("TraversabilityConfig", name, f"a number >= 0; found {value!r}")

    @property
    def crosses_unknown(self) -> bool:
        """Return True where unknown space may be crossed."""
        return math.isfinite(self.unknown)


def of_clearance(space: ClearanceMap, radius: float, config: TraversabilityConfig) -> ClearanceMap:
    """Return a known space with the weight of nearness; ``radius`` of the body, m."""
    return ClearanceMap(space.clearance, space.origin, space.resolution, _nearness(space.clearance, radius, config))


def of_plan(plan: FloorPlan, goal: np.ndarray, radius: float, config: TraversabilityConfig) -> ClearanceMap:
    """Return the space of a partly known floor plan: its unknown cells are free at a cost.

    Args:
        plan: of the belief.
        goal: ``(2,)`` m; it lies inside the building.
        radius: of the body, m.
        config: what a metre costs.

    Returns:
        Clearances, at most :data:`REACH`, with weights, over all of the plan.
    """
    unknown = plan.cells == UNKNOWN
    half = 0.5 * plan.resolution
    beyond = -half if config.crosses_unknown else half  # half a cell is the unbiased place of a border without a surface
    occupancy = np.where(np.isfinite(plan.occupancy), plan.occupancy, -1.0)
    signed = np.where(unknown, beyond, np.where(plan.cells == OCCUPIED, np.maximum(occupancy, 1e-3), occupancy))
    clearance = near_level_distance(signed, plan.resolution, REACH)
    weight = _nearness(clearance, radius, config)
    if config.crosses_unknown:
        inside = outline(plan, np.reshape(goal, (1, 2)))
        weight += np.where(unknown, np.where(inside, config.unknown, config.unknown * config.outside), 0.0)
    return ClearanceMap(clearance, plan.origin, plan.resolution, weight.astype(np.float32))


def _nearness(clearance: np.ndarray, radius: float, config: TraversabilityConfig) -> np.ndarray:
    """Return ``1 + a (1 - spare / comfort)^2``, float32 of the clearance's shape."""
    if config.comfort == 0.0:
        return np.ones_like(clearance)
    lacking = np.clip(1.0 - (clearance - radius) / config.comfort, 0.0, 1.0)
    return (1.0 + config.nearness * lacking**2).astype(np.float32)
