"""Propose candidate viewpoints: places in the belief's free space, with their path lengths from the robot (eq. P41).

    d(c) = min over paths of the robot's disc through free cells of sum |edges|          (geodesic tree, 16 neighbours)

Unknown space is not free for the body. The places cover what can be reached evenly, and more closely near frontiers.
:mod:`vssm_gym.planning.exploration.information` computes the information of a view from them, and a grid search plans
the path to them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration.frontier import frontiers, seen_unknown
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.grid_search.goal_distance import goal_distance
from vssm_gym.planning.occupancy_grid import FREE

ESCAPE = 0.3  # m around the robot within which less clearance is enough, so that it can leave a tight place
DISMISSED_PLACE = 0.2  # m around a place that was given up, within which there are no candidates


@dataclass(frozen=True)
class Roadmap:
    """Hold where a robot can go in a plan, and the path lengths.

    Attributes:
        plan: of the belief.
        clearance: of the plan, for A* and for following.
        headroom: ``(nx, ny)`` float32 the same of each cell, m; minus infinity where nothing is known.
        passable: ``(nx, ny)`` bool: cells with enough room for the robot.
        distance: ``(nx, ny)`` float32 path length from the robot, m; infinite where no path leads.
        start: ``(2,)`` m where the robot is.
        room: m of clearance that a passable cell has.
    """

    plan: FloorPlan
    clearance: ClearanceMap
    headroom: np.ndarray
    passable: np.ndarray
    distance: np.ndarray
    start: np.ndarray
    room: float

    @classmethod
    def of(cls, plan: FloorPlan, xy: Float[np.ndarray, "2"], room: float) -> "Roadmap":
        """Search from ``xy`` (m) through cells with a clearance of ``room`` (m), the robot's radius included."""
        clearance = plan.clearance()
        headroom = np.full(plan.cells.shape, -np.inf, np.float32)
        first = np.round((clearance.origin - plan.origin) / plan.resolution).astype(int)
        nx, ny = clearance.clearance.shape
        headroom[first[0] : first[0] + nx, first[1] : first[1] + ny] = clearance.clearance
        passable = headroom >= room
        # A robot that stands closer to an obstacle than it may plan to be leaves through cells with no less clearance.
        x, y = (plan.origin[a] + plan.resolution * np.arange(plan.cells.shape[a]) - xy[a] for a in (0, 1))
        near = np.hypot(x[:, None], y[None, :]) <= ESCAPE
        passable |= near & (headroom >= min(room, float(clearance.at(xy)) - 0.5 * plan.resolution))
        distance = np.where(headroom >= room, _distances(plan, passable, xy), np.float32(np.inf))
        return cls(plan, clearance, headroom, passable, distance, np.array(xy), room)

    def distances_from(self, xy: np.ndarray) -> np.ndarray:
        """Return the path length (m) from another place to each cell, ``(nx, ny)``."""
        return _distances(self.plan, self.passable, xy)

    def reaches(self, xy: np.ndarray) -> bool:
        """Return True where a path leads to the cell of a place ``(2,)``."""
        return bool(np.isfinite(self.at(self.distance, np.asarray(xy)[None]))[0])

    def at(self, distance: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """Return the values of a field of distances in the cells of world points ``(n, 2)``."""
        cell = np.clip(self.plan.index(xy), 0, np.array(distance.shape) - 1)
        return distance[cell[:, 0], cell[:, 1]]


def _distances(plan: FloorPlan, passable: np.ndarray, xy: np.ndarray) -> np.ndarray:
    gx, gy = (np.asarray(xy, np.float64) - plan.origin) / plan.resolution
    return goal_distance(passable, float(gx), float(gy)) * np.float32(plan.resolution)


def spread_places(roadmap: Roadmap, spacing: float) -> np.ndarray:
    """Return the reachable place with most clearance in each square of ``spacing`` m: ``(n, 2)`` m, nearest first."""
    plan = roadmap.plan
    cell = np.argwhere(np.isfinite(roadmap.distance) & (plan.cells == FREE))
    if not len(cell):
        return np.empty((0, 2))
    xy = plan.centres(cell)
    room = roadmap.headroom[tuple(cell.T)]
    # Squares stay where they are in the world, so that places do not wander from step to step.
    square = np.floor(xy / spacing).astype(int)
    square -= square.min(axis=0)
    key = square[:, 0] * (square[:, 1].max() + 1) + square[:, 1]
    order = np.lexsort((-room, key))
    best = order[np.unique(key[order], return_index=True)[1]]
    return xy[best[np.argsort(roadmap.at(roadmap.distance, xy[best]), kind="stable")]]


@dataclass(frozen=True)
class Candidates:
    """Hold places from which unknown space can be seen.

    Attributes:
        xy: ``(n, 2)`` m.
        distance: ``(n,)`` path length from the robot, m.
        seen: ``(n, cells)`` float32 probability that a full turn there sees an unknown cell of the plan; only
            cells that some place may see.
        cell: area of a cell, m^2.
    """

    xy: np.ndarray
    distance: np.ndarray
    seen: np.ndarray
    cell: float

    @property
    def area(self) -> np.ndarray:
        """Return the expected unknown area that each place sees, m^2."""
        return self.seen.sum(axis=1) * self.cell


def candidates(
    roadmap: Roadmap, *, spacing: float, hazard: float | np.ndarray, least_area: float, dismissed: np.ndarray
) -> Candidates:
    """Propose places over reachable free space and beside each frontier, with at least ``least_area`` m^2 to see.

    Args:
        roadmap: from where the robot is.
        spacing: edge of the squares of which each gets a place, m.
        hazard: of unknown space, 1/m: see :func:`visible_unknown`.
        least_area: m^2.
        dismissed: ``(n, 2)`` m, places that were given up, with what is within :data:`DISMISSED_PLACE` of them.
    """
    near = [frontier.goal for frontier in frontiers(roadmap.plan, roadmap.distance)]
    xy = np.concatenate([spread_places(roadmap, spacing), np.reshape(near, (-1, 2))])
    gap = np.linalg.norm(xy[:, None] - dismissed[None], axis=-1)
    xy = xy[gap.min(axis=1, initial=np.inf) > DISMISSED_PLACE]
    seen = seen_unknown(roadmap.plan, xy, hazard)
    cell = roadmap.plan.resolution**2
    worth = seen.sum(axis=1) * cell >= least_area
    return Candidates(xy[worth], roadmap.at(roadmap.distance, xy[worth]), seen[worth], cell)


def representatives(found: Candidates, most: int, decay: float, least_area: float) -> np.ndarray:
    """Select a few places that see different parts of the unknown, greedily by ``area exp(-decay distance)``.

        area(k | chosen) = sum_cells max(0, p_k - max_chosen p)

    What hides a cell from one place mostly hides it from its neighbour, because a wall is there for both. The maximum
    over places expresses that. Returns the places' numbers in the order of choice.
    """
    best = np.zeros(found.seen.shape[1], np.float32)
    chosen: list[int] = []
    near = np.exp(-decay * found.distance)
    while len(chosen) < most and len(found.xy):
        area = np.maximum(found.seen - best, 0.0).sum(axis=1) * found.cell
        k = int(np.argmax(area * near))
        if area[k] < least_area:
            break
        chosen.append(k)
        best = np.maximum(best, found.seen[k])
    return np.array(chosen, int)
