"""Keep a path to a goal as the robot and its knowledge move on: shorten it, test it, plan it anew.

Every step shortens what is left of the path from the newest estimate. The planner runs again where that fails, and
where a place has changed through which a path could lead that costs less:
``|robot - place| + |place - goal| < cost of the path``. Where no path leads to the goal, a detour leads to the frontier
that is nearest on the way to it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vssm_gym.agents.shared.following import PlannedPath
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.surroundings import Terrain
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.frontier import frontiers
from vssm_gym.planning.grid_search.clearance_requirement import path_free, requirement_from
from vssm_gym.planning.grid_search.path_cost import path_cost
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.planners import Planner
from vssm_gym.planning.result import PlanResult, PlanStatus


@dataclass(frozen=True)
class Detour:
    """Hold where a robot drives because no path leads to its goal.

    Attributes:
        end: ``(2,)`` m, from where a frontier can be seen.
        facing: rad, heading to look in there.
    """

    end: np.ndarray
    facing: float


@dataclass
class Route:
    """Keep the path to one goal, or the detour from which a path may be found.

    Attributes:
        goal: ``(2,)`` m.
        body: radius of the robot, m.
        success_radius: of the goal, m.
        config: margins, slack, gain and landing of a path.
        plan: the planner.
        path: what is left to be driven; None where it has to be planned anew.
        rim: m, radius of the goal's disc in which the path ends, where it could not end in the one asked for; else 0.
        detour: that the path leads to; None where it leads to the goal.
    """

    goal: np.ndarray
    body: float
    success_radius: float
    config: NavigationConfig
    plan: Planner
    path: PlannedPath | None = None
    rim: float = 0.0
    detour: Detour | None = None
    _seen: list[np.ndarray] = field(default_factory=list)  # (n, 2) cells of frontiers that were driven to

    def update(self, planar: np.ndarray, terrain: Terrain, stop_radius: float) -> PlanResult | None:
        """Shorten the path, or plan it anew.

        Args:
            planar: ``(3,)`` where the robot is, m and rad.
            terrain: where it can drive.
            stop_radius: m, within which of the goal the robot would stop.

        Returns:
            None where there is a path, else the planner's last result.
        """
        c, kept = self.config, None
        target = stop_radius - c.landing
        end, radius = (self.goal, max(target, self.rim)) if self.detour is None else (self.detour.end, 0.0)
        if self.path is not None:
            kept = shortened(self.path, planar, terrain.space, end, radius, self.body - c.slack)
        if kept is not None:
            # A detour is driven because no path led to the goal: whatever has changed may open one.
            opened = self.detour is not None and len(terrain.changed) > 0
            if not (opened or may_improve(terrain.changed, kept, planar, end)):
                self.path = kept
                return None
        largest = self.success_radius - 2.0 * c.landing
        attempts = [(radius, margin) for radius in (target, largest) for margin in c.margins]
        result, reached, margin = first_found(self.plan, planar, self.goal, terrain.space, self.body, attempts)
        if result.found:
            found, rim = PlannedPath(result.path, terrain.space, margin), largest if reached > target else 0.0
            if kept is None or self.detour is not None or result.cost < (1.0 - c.gain) * cost(kept):
                self.path, self.rim, self.detour = found, rim, None
            else:
                self.path = kept
            return None
        if kept is not None:  # of a detour
            self.path = kept
            return None
        self.path, self.detour = None, None
        return result

    def explore(self, planar: np.ndarray, terrain: Terrain) -> bool:
        """Plan a detour to the frontier that is nearest on the way to the goal; return True where there is one.

        Args:
            planar: ``(3,)`` where the robot is, m and rad.
            terrain: where it can drive; a map that was given has no frontiers.
        """
        if terrain.plan is None:
            return False
        roadmap = Roadmap.of(terrain.plan, planar[:2], self.body + self.config.margins[0])
        seen = np.concatenate(self._seen) if self._seen else np.empty((0, 2))
        found = frontiers(terrain.plan, roadmap.distance, dismissed=seen)
        for frontier in sorted(found, key=lambda f: f.distance + math.hypot(*(f.goal - self.goal))):
            for margin in self.config.margins:
                result = self.plan(planar, frontier.goal, roadmap.clearance, self.body, margin=margin, goal_radius=0.0)
                if result.status is PlanStatus.FOUND:
                    dx, dy = frontier.xy.mean(axis=0) - frontier.goal
                    self.path, self.rim = PlannedPath(result.path, terrain.space, margin), 0.0
                    self.detour = Detour(frontier.goal, math.atan2(dy, dx))
                    self._seen.append(frontier.xy)
                    return True
        return False

    def end_detour(self) -> float:
        """Forget the detour and its path; return the heading to look in, rad."""
        assert self.detour is not None
        facing, self.detour, self.path = self.detour.facing, None, None
        return facing


def shortened(
    old: PlannedPath, planar: np.ndarray, space: ClearanceMap, end: np.ndarray, radius: float, body: float
) -> PlannedPath | None:
    """Return what is left of a path in the present space; None where it is not free any more.

    Args:
        old: the path as it was.
        planar: ``(3,)`` where the robot is.
        space: as it is known now.
        end: ``(2,)`` m; the path may end within ``radius`` of it. With 0 it ends where it did.
        radius: m.
        body: clearance that the path must have beyond its margin, m.
    """
    path = _extended(old, space, end, radius, body)
    if path is None:
        return None
    points = np.concatenate([planar[None, :2], path[1:]])
    asked = requirement_from(space, points[0], body + old.margin)
    shorter = shorten_path(space, points, end, radius, asked)
    if shorter is None or not path_free(space.clearance, space.resolution, space.to_grid(shorter), asked):
        return None
    return PlannedPath(shorter, space, old.margin)


def _extended(old: PlannedPath, space: ClearanceMap, end: np.ndarray, radius: float, body: float) -> np.ndarray | None:
    """Extend a path straight to the goal's disc where that has shrunk since; None where that is not free."""
    path, offset = old.path, old.path[-1] - end
    away = float(np.hypot(*offset))
    if away <= radius + 1e-9 or radius == 0.0:
        return path
    rim = end + offset * (radius / away)
    between = np.linspace(path[-1], rim, 2 + int((away - radius) / space.resolution))
    return np.concatenate([path, [rim]]) if space.at(between).min() >= body + old.margin else None


def may_improve(changed: np.ndarray, path: PlannedPath, planar: np.ndarray, end: np.ndarray) -> bool:
    """``any |robot - place| + |place - end| < cost``: a path that costs less may lead through a place that has changed.

    The weight of a path is at least 1 a metre: outside of this ellipse no change can make a cheaper one.
    """
    here, there = (np.hypot(*(changed - place).T) for place in (planar[:2], end))
    return bool(np.any(here + there < cost(path)))


def first_found(
    plan: Planner,
    planar: np.ndarray,
    goal: np.ndarray,
    space: ClearanceMap,
    body: float,
    attempts: Sequence[tuple[float, float]],
) -> tuple[PlanResult, float, float]:
    """Plan with each ``(goal radius, margin)`` in turn, m; return the first path found, or the last result."""
    for radius, margin in attempts:
        result = plan(planar, goal, space, body, margin=margin, goal_radius=radius)
        if result.found:
            break
    return result, radius, margin


def cost(path: PlannedPath) -> float:
    """``integral of w ds`` along a path, in the space that it was planned in, m (eq. P2b)."""
    space = path.clearance
    return space.resolution * float(path_cost(space.weights, space.to_grid(path.path)))
