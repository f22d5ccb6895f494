"""Plan paths of a disc, by a planner's name: ``(start, goal, space, radius, ...) -> PlanResult``.

An agent takes a planner as an argument. A new planner is one file and one row of :data:`PLANNERS`;
``tests/planning/test_planners.py`` holds every row to the protocol on every kind of space.
"""

from typing import Protocol

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.planning.clearance import Space
from vssm_gym.planning.grid_search.astar import plan as astar
from vssm_gym.planning.grid_search.theta_star import plan as theta_star
from vssm_gym.planning.result import PlanResult


class Planner(Protocol):
    """``min integral of w ds``: plan a path of a disc through a space, or report why there is none; m, world frame.

    The weight w is the space's; without one the path is short, with one cheap.
    The path is a polyline from the start. Everywhere on it the clearance is at least ``radius + margin``. A start with
    less clearance is left along a ramp, see
    :func:`vssm_gym.planning.grid_search.clearance_requirement.requirement_from`. Equal arguments give equal results.
    """

    def __call__(
        self,
        start: np.ndarray,
        goal: np.ndarray,
        space: Space,
        radius: float,
        *,
        margin: float = 0.0,
        goal_radius: float = 0.0,
        max_expansions: int = 1_000_000,
    ) -> PlanResult:
        """Plan a short path of a disc of ``radius`` from ``start`` to within ``goal_radius`` of ``goal``.

        Args:
            start: ``(2,)`` or planar pose ``(3,)``, of which the position counts.
            goal: ``(2,)``, likewise.
            space: clearance of the disc's centre: an array, or a function of the place.
            radius: of the body.
            margin: extra clearance everywhere on the path; negative: less than the body's radius is enough.
            goal_radius: the path may end at any point so near to the goal. Where it is smaller than the grid can
                resolve, the path ends at the free node nearest to the goal or, if a free segment leads there, at it.
            max_expansions: closed nodes after which the search gives up: a count, so that runs repeat exactly.

        Returns:
            Status, path, its cost (eq. P2b) and time. A start or a goal that cannot be reached is a status;
            :class:`InputError` is raised only for arguments that are not finite numbers.
        """
        ...


PLANNERS: dict[str, Planner] = {
    "astar": astar,
    "theta_star": theta_star,
}


def find_planner(planner: str | Planner) -> Planner:
    """Return the planner of a name, or ``planner`` itself; an unknown name raises :class:`InputError`."""
    if callable(planner):
        return planner
    if planner not in PLANNERS:
        raise InputError(
            "configuration", "planner", f"one of {', '.join(PLANNERS)}, or a Planner; found {planner!r:.80}"
        )
    return PLANNERS[planner]


def plan(
    start: np.ndarray,
    goal: np.ndarray,
    space: Space,
    radius: float,
    *,
    planner: str | Planner = "astar",
    margin: float = 0.0,
    goal_radius: float = 0.0,
    max_expansions: int = 1_000_000,
) -> PlanResult:
    """Plan a short path of a disc of ``radius`` from ``start`` to within ``goal_radius`` of ``goal``.

    Args:
        start: ``(2,)`` position or ``(3,)`` planar pose in the world frame, m; of a pose the position counts.
        goal: ``(2,)`` or ``(3,)``, likewise.
        space: the clearance of the disc's centre: a :class:`~vssm_gym.planning.clearance.ClearanceMap`, or a
            :class:`~vssm_gym.planning.clearance.ClearanceField` for a function.
        radius: of the disc, m.
        planner: a name of :data:`PLANNERS`, or any callable with this signature but for ``planner``.
        margin: extra clearance everywhere on the path, m; a negative one accepts less than the radius.
        goal_radius: distance from the goal that is near enough, m.
        max_expansions: closed nodes after which the search gives up: a count, so that runs repeat exactly.

    Returns:
        Status, path, path length and time. A start or a goal that cannot be reached is a status.

    Raises:
        InputError: an unknown planner, or a start or goal that is no finite position.
    """
    return find_planner(planner)(
        start, goal, space, radius, margin=margin, goal_radius=goal_radius, max_expansions=max_expansions
    )
