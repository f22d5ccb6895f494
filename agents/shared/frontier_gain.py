"""Choose the frontier with most unknown area in sight for its path length (Gonzalez-Banos and Latombe 2002).

goal = argmax_f A(f) exp(-lambda (d(f) + c |b(f)|))     A: unknown area in sight of the goal, m^2; d: path length, m

``b`` is the bearing of the frontier, rad, for a robot that turns towards what it drives to; c is 0 as published.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.shared.strategy import Choice, Situation, around
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.exploration.building_prior import expected_surfaces
from vssm_gym.planning.exploration.frontier import frontiers, seen_unknown


@dataclass(frozen=True)
class FrontierGainConfig:
    """Configure ``frontier_gain``."""

    decay: float = 0.2  # lambda, 1/m, as published
    turn: float = 0.0  # c, m of path that a turn by a radian costs as much as
    least: float = 0.0  # m^2 in sight of a frontier, of which less is not worth a drive
    # 1/m, of surfaces in unknown space: in the building's outline, and beyond. As published there are none.
    hazard: tuple[float, float] = (0.0, 0.0)


class FrontierGain:
    """Choose the frontier of the greatest utility."""

    def __init__(self, config: FrontierGainConfig) -> None:
        self._config = config

    def reset(self, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing."""

    def choose(self, situation: Situation) -> Choice | None:
        """Return the goal of the frontier with the greatest utility, and a full turn there."""
        plan = situation.roadmap.plan
        found = frontiers(plan, situation.roadmap.distance, dismissed=situation.dismissed)
        if not found:
            return None
        hazard = expected_surfaces(plan, *self._config.hazard)
        seen = seen_unknown(plan, np.array([frontier.goal for frontier in found]), hazard)
        area = seen.sum(axis=1) * plan.resolution**2
        away = np.array([frontier.distance for frontier in found])
        x, y = np.array([frontier.goal for frontier in found]).T - situation.planar[:2, None]
        turns = np.abs(wrap_angle(np.arctan2(y, x) - situation.planar[2]))
        utility = area * np.exp(-self._config.decay * (away + self._config.turn * turns))
        k = int(np.argmax(np.where(area >= self._config.least, utility, -1.0)))
        if area[k] < self._config.least:
            return None
        best = found[k]
        dx, dy = best.xy.mean(axis=0) - best.goal
        heading = math.atan2(dy, dx)
        status = f"to {area[k]:.1f} m^2 at {away[k]:.1f} m, the best of {len(found)} frontiers"
        return Choice(best.goal, (heading, *around(heading)), best.xy, status)
