"""Keep the cost-to-go of one target on a floor plan that grows: computed again where the plan has changed, warm.

The grid of poses is fixed in the world, so that the sweeps start from the last values and nothing is compiled again. It
covers the start, the target and some room around both; where no path leads through it, it is enlarged. Unknown cells
are passable, at the price of several motions for one.

The actor keeps off unknown space: what it drives onto has to be seen before. Where the route would meet unseen cells
that the camera does not show on the poses before (:mod:`vssm_gym.agents.shared.car.looking`), the actor is led first to
the nearest pose from which they are seen, by a second cost-to-go, where the way there risks less: what lies behind the
car is unseen, too. Unseen cells that are met on the route to that pose, or on the other where it looks at nothing, or
before which the car does not get on, it may drive onto; it dares, slowly, and one motion
at a time: what it has seen meanwhile may lead to a route that needs no other. They keep their price.

It is computed again where the change matters: cells near the route became occupied, many cells changed, what was to be
looked at was seen, or is not seen from where it should be, what was dared was driven onto, the car has left the poses
with a path, or there is none yet.

Where the actor does not find a way to drive its route, again and again, the car is led along the route itself.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from vssm_gym.agents.shared.car.critic import ATTEMPTS, path_nearby
from vssm_gym.agents.shared.car.looking import SEEN_MARGIN, Sight
from vssm_gym.agents.shared.car.plan_window import PlanWindow
from vssm_gym.agents.shared.car.routes import descend, way_out
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.planning.car.footprint import Arena, heading_grid, overlaps, rectangle_collisions
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import OCCUPIED, UNKNOWN
from vssm_gym.planning.value_iteration import (
    CostToGo,
    Counts,
    PoseGrid,
    ValueConfig,
    ValueResult,
    ValueStatus,
    solve,
    solve_region,
)

TOLERANCE = 0.02  # motions, of the Bellman residual
SEEN_SHARE = 0.7  # of a patch, from which on it has been looked at
DRIVEN_SHARE = 0.5  # of the cells that it dared, from which on it has driven onto them: their edge it only passes
LOOKED = 3  # steps in a row at a pose to look from, after which it does not show what it was to show
DRIVEN_REST = 0.3  # of the motion that it dared are left where it has driven it
DARED = 5  # motions of a route on which a car that does not get on dares: 0.66 m
WIDEST = 2  # cells around what it dares
LED_FROM = 3  # times in a row that it does not get on, from which on it is led
CAREFUL = 0.2  # m ahead of a car that drives onto unseen cells, within which it is careful
NONE: np.ndarray = np.zeros((0, 2), int)  # cells


@dataclass(frozen=True)
class GrowingConfig:
    """Configure the grid, and when the cost-to-go is computed again.

    Args:
        sides: cells of the grid along x and y, tried in turn.
        room: m around start and target that the first grid holds.
        unknown: motions that one forwards, and one backwards, over unseen cells counts.
        near: m around the footprint on its route, within which a new obstacle matters.
        changed: cells that change anywhere before the values are computed again.
        pause: steps from one computation to the next, unless an obstacle lies on the route.
    """

    sides: tuple[int, ...] = (120, 160, 240, 360)
    room: float = 0.8
    unknown: tuple[float, float] = (6.0, 60.0)
    near: float = 0.05
    changed: int = 200
    pause: int = 10


class GrowingCritic:
    """Follow one target of one car on a growing floor plan.

    ``value`` is the newest cost-to-go of the target, ``aim`` that by which the actor drives: of the target, or of the
    poses from which it looks first. Both are None without a path.
    """

    def __init__(self, car: Car, goal: np.ndarray, half_angle: float, config: GrowingConfig | None = None) -> None:
        """Follow ``goal`` ``(2,)`` or ``(3,)`` by a camera whose view is ``half_angle`` wide on either side, rad."""
        self._half_angle = half_angle
        self._car, self._goal, self._config = car, np.asarray(goal, np.float64), config or GrowingConfig()
        self._side, self._corner = 0, np.zeros(2)
        self._used: np.ndarray | None = None  # cells for which the value was computed
        self._near: np.ndarray = np.zeros((0, 0), bool)
        self._waited = 0  # steps since then
        self.value: CostToGo | None = None
        self.aim: CostToGo | None = None
        self._followed: CostToGo | None = None  # `aim` with the price of unseen space
        self._stale = False  # it has to be computed again at the next update
        self._patch: np.ndarray = NONE  # cells that it looks at first
        self._daring: np.ndarray = NONE  # cells that it may drive onto unseen
        self._until = -np.inf  # motions that are left when it has driven onto them
        self._dared: np.ndarray = np.zeros((0, 0), bool)  # the same, and room around them
        self._looked = 0  # steps in a row at a pose to look from
        self._vain: np.ndarray = np.zeros((0, 0), bool)  # cells that it has not seen from where it should have
        self._failed = 0  # times in a row that it did not get on: what cannot be driven around is worth its risk
        self._bold = False  # it may drive onto what it meets first, seen in time or not
        self.status = ValueStatus.UNREACHABLE
        self.computed = 0  # how often
        self._window: PlanWindow  # the newest plan on the grid

    def update(self, plan: FloorPlan, planar: np.ndarray) -> None:
        """Take the newest floor plan, and the pose of the car (m, rad); compute the cost-to-go again if need be."""
        if self._used is None:
            self._place(plan, planar, 0)
        self._cut(plan)
        self._waited += 1
        if not self._matters(self._window.cells, planar):
            return
        self._compute(planar)
        while self.value is None and self._side + 1 < len(self._config.sides):
            self._place(plan, planar, self._side + 1)
            self._cut(plan)
            self._compute(planar)

    @property
    def looks(self) -> bool:
        """Return True where the car is to look at something before it drives on."""
        return len(self._patch) > 0

    @property
    def hesitates(self) -> bool:
        """Return True where the car has not got on so often in a row that it is to be led (:meth:`lead`)."""
        return self._failed >= LED_FROM

    def motions(self, planar: np.ndarray) -> float:
        """Return how many motions are left from a pose to where the actor is led; infinite without a path."""
        if self.aim is None:
            return np.inf
        here: Any = np.asarray(planar, np.float32)
        share = max(1.0 - float(self.aim.at(here)) / self.aim.never, 1e-9)  # gamma^motions
        return float(np.log(share) / np.log(self.aim.gamma))

    def clearance(self) -> ClearanceMap:
        """Return the distance to what is occupied or unseen, which the actor has to keep."""
        return self._window.clearance(self._window.unseen & ~self._dared)

    def dare(self, planar: np.ndarray) -> bool:
        """Decide anew at the next update, as the car does not get on; unseen space is cheaper if little was seen since.

        The car may drive onto the unseen cells that it meets first on the new route. What it was to look at from where
        it already is, it looks at no more. False where it was to do neither.
        """
        if self._followed is None:
            return False
        met = self._sight(self._window.unseen).first_met(descend(self._followed, planar, self._car)[:DARED])
        if met is None and not self.looks:
            return False
        if self._used is None or np.count_nonzero(self._window.cells != self._used) < self._config.changed:
            if met is None:
                self._vain[tuple(self._patch.T)] = True
            self._failed, self._bold = self._failed + 1, True
        self._stale = True
        return True

    def lead(self, planar: np.ndarray) -> np.ndarray | None:
        """Return the next poses ``(n, 3)`` of the route that the car may drive; None where it may not drive on.

        They end before the first unseen cells that it does not dare.
        """
        if self._followed is None:
            return None
        route = descend(self._followed, planar, self._car)[: DARED + 1]
        met = self._sight(self._window.unseen & ~self._dared).first_met(route)
        route = route if met is None else route[:met]
        if len(route) > 1:
            return route
        return way_out(self._followed, planar, self._car, self._window, self._dared)

    def careful(self, planar: np.ndarray, control: np.ndarray) -> bool:
        """Return True where a command ``(speed, steering)`` leads onto unseen cells within :data:`CAREFUL`."""
        cells = self._dared & (self._window.cells == UNKNOWN)
        lengths = np.copysign(CAREFUL, control[0]) * np.array([0.0, 0.5, 1.0])
        turns = turn_of(lengths, float(control[1]), self._car.wheelbase)
        ends = poses_after(planar[2], lengths, turns, *planar[:2])
        return any(overlaps(cells, self._window.corner, self._window.resolution, pose, self._car) for pose in ends)

    def forget(self) -> None:
        """Compute the cost-to-go again at the next update, from scratch: the car does not get on by this one."""
        self.value = self.aim = self._followed = None
        self._stale = True

    def _place(self, plan: FloorPlan, planar: np.ndarray, side: int) -> None:
        """Choose the first grid from ``side`` on that holds car and target with room, on the cells of the plan."""
        ends = np.stack([planar[:2], self._goal[:2]])
        span = float(np.ptp(ends, axis=0).max()) + 2.0 * self._config.room
        sides = self._config.sides
        while side + 1 < len(sides) and sides[side] * plan.resolution < span:
            side += 1
        wanted = ends.mean(axis=0) - 0.5 * (sides[side] - 1) * plan.resolution
        self._side = side
        self._corner = plan.origin + np.round((wanted - plan.origin) / plan.resolution) * plan.resolution
        self.value = None
        self._dared, self._vain = (np.zeros((sides[side], sides[side]), bool) for _ in range(2))
        self._daring = NONE

    def _cut(self, plan: FloorPlan) -> None:
        """Take the newest plan on the grid."""
        self._window = PlanWindow.cut(plan, self._corner, self._config.sides[self._side])

    def _matters(self, cells: np.ndarray, planar: Any) -> bool:
        """Return True where the cost-to-go has to be computed again."""
        if self._stale or self._used is None or self._used.shape != cells.shape:
            return True
        appeared = (cells == OCCUPIED) & (self._used != OCCUPIED)
        if (appeared & self._near).any():
            return True
        if self.looks and self._window.unseen[tuple(self._patch.T)].mean() < 1.0 - SEEN_SHARE:
            return True
        self._looked = self._looked + 1 if self.looks and self.motions(planar) <= 0.0 else 0
        if self._looked > LOOKED:
            self._vain[tuple(self._patch.T)] = True
            return True
        if len(self._daring):
            driven = (cells[tuple(self._daring.T)] == UNKNOWN).mean() < 1.0 - DRIVEN_SHARE
            if driven or self.motions(planar) <= self._until:
                self._failed = 0
                return True
        if self._waited < self._config.pause:
            return False
        changed = np.count_nonzero(cells != self._used) >= self._config.changed and not self.looks
        return bool(changed or self.aim is None or not self.aim.reachable(planar))

    def _compute(self, planar: np.ndarray) -> None:
        """Compute the cost-to-go with the widest margin that has a path, and what has to be looked at first."""
        cells = self._window.cells
        grid_of = self._grids()

        def to_goal(grid: PoseGrid, share: float, start: np.ndarray | None) -> ValueResult:
            region = share * GOAL_RADIUS, share * GOAL_HEADING_TOLERANCE
            return solve(grid, self._goal, *region, start=start, warm=self.value)

        result = self._best(grid_of, planar, to_goal)
        self.value, self.status = result.cost_to_go, result.status
        self.aim, self._followed = None, self.value
        self._used, self._patch, self._near = cells, NONE, np.zeros(cells.shape, bool)
        self._waited = self._looked = 0
        self._dare(NONE)
        self._until = -np.inf
        bold, self._bold = self._bold, False
        self.computed, self._stale = self.computed + 1, False
        if self._followed is None:
            return
        route = descend(self._followed, planar, self._car)
        hoped = self._sight(self._window.unseen & ~self._vain)
        patch = hoped.blind(route)
        if len(patch):
            shows = hoped.viewpoints(patch, ValueConfig().n_headings)
            look = self._best(grid_of, planar, lambda grid, _, start: solve_region(grid, shows & ~grid.blocked, start))
            if look.cost_to_go is not None:
                around, prices = descend(look.cost_to_go, planar, self._car), self._config.unknown
                # To look is worth less than it risks where the way there is itself unseen, such as what lies behind.
                if hoped.risk(around, prices) < hoped.risk(route, prices):
                    self._followed, self._patch, route = look.cost_to_go, patch, around
        self.aim = replace(self._followed, counts=None)
        sight = self._sight(self._window.unseen)
        first = sight.first_blind(route)
        if first is None and bold:
            first = sight.first_met(route[:DARED])
        if first is not None:
            self._dare(sight.swept(route[first - 1 : first + 1]))
            before, after = (self.motions(pose) for pose in route[first - 1 : first + 1])
            self._until = after + DRIVEN_REST * (before - after)
        self._near = self._window.around(route, self._car, self._config.near)

    def _sight(self, unseen: np.ndarray) -> Sight:
        """Return what is seen from where on the newest plan, some of whose cells are unseen."""
        window = self._window
        return Sight(window.occupied, unseen, window.corner, window.resolution, self._car, self._half_angle)

    def _dare(self, patch: np.ndarray) -> None:
        """Let the actor drive onto a patch of cells as if they were seen; around it only where it failed to before."""
        self._daring, self._dared = patch, np.zeros_like(self._dared)
        self._dared[tuple(patch.T)] = True
        if self._failed:
            self._dared = binary_dilation(self._dared, iterations=min(self._failed, WIDEST))

    def _grids(self) -> Callable[[float], PoseGrid]:
        """Return the newest plan's poses and motions for a margin (m), which are worked out once for each."""
        occupied = self._window.occupied
        clearance = self._window.clearance(np.zeros_like(occupied))
        arena = Arena(occupied, clearance, self._window.corner, self._window.resolution)
        counts = self._counts()

        @cache
        def grid_of(margin: float) -> PoseGrid:
            return PoseGrid.of(arena, self._car, ValueConfig(margin=margin, tolerance=TOLERANCE), counts)

        return grid_of

    def _counts(self) -> Counts:
        """Return how many motions one from poses over unseen cells counts; each failure halves what is above 1."""
        headings = heading_grid(ValueConfig().n_headings)
        over = rectangle_collisions(self._window.unseen, self._window.resolution, self._car, headings, SEEN_MARGIN)
        priced = [1.0 + 0.5**self._failed * (count - 1.0) for count in self._config.unknown]
        return Counts(over, np.array(priced, np.float32))

    def _best(
        self,
        grid_of: Callable[[float], PoseGrid],
        planar: np.ndarray,
        solved: Callable[[PoseGrid, float, np.ndarray | None], ValueResult],
    ) -> ValueResult:
        """Return the result with the widest margin that has a path."""
        for margin, share in ATTEMPTS:
            grid = grid_of(margin)
            result = solved(grid, share, planar)
            if result.status is ValueStatus.START_BLOCKED:  # by the map, whose surfaces have errors
                result = solved(grid, share, None)
                if result.cost_to_go is not None and not path_nearby(result.cost_to_go, planar):
                    result = replace(result, status=ValueStatus.UNREACHABLE, cost_to_go=None)
            if result.cost_to_go is not None:
                return result
        return result
