"""Weigh where a robot should drive, a cost a metre (eq. P2c).

    w = 1 + a (1 - spare / comfort)^2 + b (1 - spare / skin) + u [unknown]

The clearance says where a body fits. The weight says where it had better not go although it fits: close to obstacles,
where there is room elsewhere, and through space that nobody has seen. ``spare`` is the clearance beyond the body's
radius; each term is zero where its bracket is negative. Comfort grows with the noise of a step. The skin is what a
learned surface errs by. Unknown space is crossed at a cost, so that a robot drives towards a goal that it cannot see
yet; with an infinite cost it is as good as occupied.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration.building_prior import outline
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.near_distance import near_level_distance
from vssm_gym.planning.occupancy_grid import OCCUPIED, UNKNOWN

REACH = 0.7  # m, up to which clearances in a growing map are computed; no robot asks for more


@dataclass(frozen=True)
class TraversabilityConfig:
    """Configure what a metre costs beyond its length.

    Attributes:
        comfort: m of spare clearance from which on nothing is gained by more, for a robot without noise.
        deviations: standard deviations of a step's length that the comfort grows by.
        nearness: a, added where the body just fits.
        skin: m of spare clearance below which a learned surface may be met.
        contact: b, added where the body just fits.
        unknown: added in unknown space: 0 is the optimist who expects nothing there; infinity never enters.
        outside: factor of ``unknown`` beyond the rectangle around all that is known and the goal.
    """

    comfort: float = 0.04
    deviations: float = 1.5
    nearness: float = 0.3
    skin: float = 0.03
    contact: float = 0.5
    unknown: float = 0.4
    outside: float = 3.0

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            if not value >= 0.0 or (name != "unknown" and math.isinf(value)):
                raise InputError("TraversabilityConfig", name, f"a number >= 0; found {value!r}")

    @property
    def crosses_unknown(self) -> bool:
        """Return True where unknown space may be crossed."""
        return math.isfinite(self.unknown)


@dataclass(frozen=True)
class Body:
    """Hold what a space is weighed for: the body's radius, and the standard deviation of a step's length, m."""

    radius: float
    step_std: float


def of_clearance(space: ClearanceMap, body: Body, config: TraversabilityConfig) -> ClearanceMap:
    """Return a known space with the weight of nearness."""
    return replace(space, weight=_nearness(space.clearance, body, config))


def of_plan(plan: FloorPlan, goal: np.ndarray, body: Body, config: TraversabilityConfig) -> ClearanceMap:
    """Return the space of a partly known floor plan: its unknown cells are free at a cost.

    Args:
        plan: of the belief.
        goal: ``(2,)`` m; it lies inside the building.
        body: that drives.
        config: what a metre costs.

    Returns:
        Clearances, at most :data:`REACH`, with weights, over all of the plan.
    """
    unknown = plan.cells == UNKNOWN
    half = 0.5 * plan.resolution
    beyond = (
        -half if config.crosses_unknown else half
    )  # half a cell is the unbiased place of a border without a surface
    occupancy = np.where(np.isfinite(plan.occupancy), plan.occupancy, -1.0)
    signed = np.where(unknown, beyond, np.where(plan.cells == OCCUPIED, np.maximum(occupancy, 1e-3), occupancy))
    clearance = near_level_distance(signed, plan.resolution, REACH)
    weight = _nearness(clearance, body, config)
    if config.crosses_unknown:
        inside = outline(plan, np.reshape(goal, (1, 2)))
        weight += np.where(unknown, np.where(inside, config.unknown, config.unknown * config.outside), 0.0)
    return ClearanceMap(clearance, plan.origin, plan.resolution, weight.astype(np.float32))


def _nearness(clearance: np.ndarray, body: Body, config: TraversabilityConfig) -> np.ndarray:
    """Return ``1 + a (1 - spare / comfort)^2 + b (1 - spare / skin)``, float32 of the clearance's shape."""
    spare, comfort = clearance - body.radius, config.comfort + config.deviations * body.step_std
    weight = np.ones_like(clearance, dtype=np.float32)
    if comfort > 0.0:
        weight += config.nearness * np.clip(1.0 - spare / comfort, 0.0, 1.0) ** 2
    if config.skin > 0.0:
        weight += config.contact * np.clip(1.0 - spare / config.skin, 0.0, 1.0)
    return weight
