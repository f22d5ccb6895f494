"""Keep a path to a goal as the robot and its knowledge move on: shorten it, test it, plan it anew."""

from collections.abc import Sequence

import numpy as np

from vssm_gym.agents.shared.following import PlannedPath
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.grid_search.clearance_requirement import path_free, requirement_from
from vssm_gym.planning.grid_search.path_cost import path_cost
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.planners import Planner
from vssm_gym.planning.result import PlanResult


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
