"""Solve for the cost-to-go on a grid of (x, y, heading): ``V(s) = min_a 1 + gamma sum_c w_c(s, a) V(c)`` (eq. P18).

``c`` runs over the four poses of the grid around the end of arc ``a``, and ``w_c`` are bilinear weights. A motion costs
1, ``V = 0`` at the goal, ``V = 1 / (1 - gamma)`` in collision. Arcs on which the footprint overlaps an occupied cell
anywhere are no motions. A motion may count ``k`` times, where a map is not known: its cost is then ``1 + gamma + .. +
gamma^(k - 1)`` and its discount ``gamma^k``.
"""

import time
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.planning.car.footprint import Arena, collides, heading_grid, rectangle_collisions
from vssm_gym.planning.result import Outcome
from vssm_gym.planning.value_iteration import sweeps
from vssm_gym.planning.value_iteration.cost_to_go import CostToGo
from vssm_gym.planning.value_iteration.counts import Counts
from vssm_gym.planning.value_iteration.motions import Motions
from vssm_gym.planning.value_iteration.reachability import flood


class ValueStatus(Outcome):
    """Name the outcome of value iteration; the value is the message that reports print."""

    CONVERGED = "converged: the Bellman residual is below the tolerance everywhere"
    NOT_CONVERGED = "not converged: the sweeps allowed ran out before the Bellman residual was small"
    GOAL_BLOCKED = "no cost-to-go: the car collides at every pose of the goal region"
    START_BLOCKED = "refused: the car collides at the start"
    UNREACHABLE = "refused: no motions lead from the start to the goal"


@dataclass(frozen=True)
class ValueConfig:
    """Configure grid and motions of the solver; the defaults are those that docs/planning.md measures."""

    n_headings: int = 64
    turns: tuple[int, ...] = (-3, -1, 0, 1, 3)  # steps of the heading grid a motion turns; the largest is full lock
    gamma: float = 0.99  # discount of one motion
    tolerance: float = 1e-3  # Bellman residual, in motions
    max_sweeps: int = 2000  # rounded up to a multiple of 4
    warm_sweeps: int = 64  # a warm start that takes longer is given up, because starting from scratch is then faster
    margin: float = 0.0  # m by which the footprint grows on all sides

    def __post_init__(self) -> None:
        if not 0.0 < self.gamma < 1.0:
            raise InputError("ValueConfig", "gamma", f"a discount between 0 and 1; found {self.gamma!r}")
        # float32 resolves W to 1e-7 of 1 / (1 - gamma); below a hundred times that the residual is rounding.
        if not self.tolerance >= 1e-5 / (1.0 - self.gamma):
            least = 1e-5 / (1.0 - self.gamma)
            raise InputError("ValueConfig", "tolerance", f"at least {least:.1g} in float32; found {self.tolerance!r}")
        if not (np.isfinite(self.margin) and self.margin >= 0.0):
            raise InputError("ValueConfig", "margin", f"metres, not negative; found {self.margin!r}")
        if self.max_sweeps < 1:
            raise InputError("ValueConfig", "max_sweeps", f"at least one; found {self.max_sweeps!r}")


@dataclass(frozen=True)
class ValueResult:
    """Hold a cost-to-go, or the reason why there is none.

    Attributes:
        status: How it ended.
        cost_to_go: ``V``; None unless status is CONVERGED or NOT_CONVERGED.
        residual: ``max |V - T V|`` over all states, in motions; infinite without a cost-to-go.
        sweeps: Sweeps over all states, those of a warm start that was given up included.
        seconds: Wall-clock time of the call.
        free: Poses of the grid without collision.
        unreachable: How many of them have no path to the goal.
    """

    status: ValueStatus
    cost_to_go: CostToGo | None
    residual: float
    sweeps: int
    seconds: float
    free: int
    unreachable: int

    @property
    def solved(self) -> bool:
        """Return True where there is a cost-to-go with a small residual."""
        return self.status is ValueStatus.CONVERGED


@dataclass(frozen=True)
class PoseGrid:
    """Hold what value iteration needs of one arena, for any goal in it: colliding poses and free motions.

    Attributes:
        arena: The occupied cells; the poses stand at their centres.
        motions: The arcs.
        config: Discount, margin, tolerance.
        blocked: ``(nx, ny, n_headings)`` bool, poses in collision.
        counts: how many motions one counts; None: one everywhere.
        layout, problem: The sweeps' own arrays.
    """

    arena: Arena
    motions: Motions
    config: ValueConfig
    blocked: np.ndarray
    counts: Counts | None
    layout: sweeps.Layout
    problem: sweeps.Problem

    @classmethod
    def of(cls, arena: Arena, car: Car, config: ValueConfig | None = None, counts: Counts | None = None) -> "PoseGrid":
        """Test the footprint at every pose and along every motion: 0.1 s for 160 x 128 x 64 poses and 10 motions."""
        config = config or ValueConfig()
        if counts is not None:
            counts = counts.checked((*arena.occupied.shape, config.n_headings))
        motions = Motions.of(car, config.n_headings, config.turns)
        layout = sweeps.layout_of(motions, arena.occupied.shape, arena.resolution)
        headings = heading_grid(config.n_headings)
        blocked = rectangle_collisions(arena.occupied, arena.resolution, car, headings, config.margin)
        arcs = motions.collisions(arena.occupied, arena.resolution, config.margin)
        problem = sweeps.problem_of(motions, layout, arena.resolution, arcs, counts, config.gamma)
        return cls(arena, motions, config, blocked, counts, layout, problem)

    @cached_property
    def _flood_arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the arguments of :func:`flood` after the goal."""
        low, weights = sweeps.corners_of(self.motions, self.arena.resolution)
        row = self.layout.row
        offsets = (low[..., 0] * row + low[..., 1])[..., None] + np.array([0, 1, row, row + 1])
        return self.problem.allowed, self.motions.heading_steps, offsets, weights > 0.0

    def goal_poses(self, goal: np.ndarray, radius: float, heading_tolerance: float) -> np.ndarray:
        """Return the free poses at the goal, ``(nx, ny, n_headings)`` bool.

        They lie within ``radius`` (m) and, where ``goal`` is a pose, ``heading_tolerance`` (rad). Both are enlarged
        where the region around the goal would hold no pose of the grid.
        """
        radius = max(radius, np.sqrt(0.5) * self.arena.resolution + 1e-9)
        centres = [self.arena.origin[a] + self.arena.resolution * np.arange(self.blocked.shape[a]) for a in (0, 1)]
        near = np.hypot(centres[0][:, None] - goal[0], centres[1] - goal[1]) <= radius
        at_goal = ~self.blocked & near[:, :, None]
        if len(goal) == 3:
            n = self.config.n_headings
            error = (heading_grid(n) - goal[2] + np.pi) % (2.0 * np.pi) - np.pi
            at_goal &= np.abs(error) <= max(heading_tolerance, np.pi / n + 1e-9)
        return at_goal


def solve(
    grid: PoseGrid,
    goal: np.ndarray,
    radius: float = GOAL_RADIUS,
    heading_tolerance: float = GOAL_HEADING_TOLERANCE,
    start: np.ndarray | None = None,
    warm: CostToGo | None = None,
) -> ValueResult:
    """Compute the cost-to-go of one goal.

    Args:
        grid: Of the arena and the car.
        goal: ``(x, y)`` in metres, or ``(x, y, heading)`` for a pose.
        radius: Of the goal region, m.
        heading_tolerance: Of a pose, rad.
        start: ``(x, y, heading)``; one that collides or has no path to the goal is refused before any sweep. A start
            counts as reachable if one of the 27 poses of the grid around it is.
        warm: The cost-to-go of a similar goal or map on the same grid, where sweeps start. The result is the same up
            to the tolerance; where it is not soon reached the sweeps start again from scratch.

    Raises:
        InputError: a goal or start of another shape or not finite, or a warm start of another grid.
    """
    at_goal = grid.goal_poses(_vector("goal", goal, (2, 3)), radius, heading_tolerance)
    return solve_region(grid, at_goal, start, warm)


def solve_region(
    grid: PoseGrid, at_goal: np.ndarray, start: np.ndarray | None = None, warm: CostToGo | None = None
) -> ValueResult:
    """Compute the cost-to-go of a set of free poses ``(nx, ny, n_headings)`` bool; else as :func:`solve`."""
    began = time.perf_counter()
    config, layout = grid.config, grid.layout
    free = int(np.count_nonzero(~grid.blocked))

    def ended(status: ValueStatus, unreachable: int = free) -> ValueResult:
        return ValueResult(status, None, np.inf, 0, time.perf_counter() - began, free, unreachable)

    if start is not None:
        start = _vector("start", start, (3,))
        if collides(grid.arena, start, grid.motions.car, 0.0):
            return ended(ValueStatus.START_BLOCKED)
    if not at_goal.any():
        return ended(ValueStatus.GOAL_BLOCKED)
    flat_goal = layout.flat(np.moveaxis(at_goal, -1, 0))
    reached = flood(flat_goal, *grid._flood_arrays)
    unreachable = free - int(np.count_nonzero(reached))
    if start is not None and not _around(layout.cells(reached), grid, start).any():
        return ended(ValueStatus.UNREACHABLE, unreachable)

    never = 1.0 / (1.0 - config.gamma)
    run = lambda first, limit: sweeps.iterate(
        grid.problem, flat_goal, first, layout, config.gamma, never, config.tolerance, limit
    )
    done = 0
    if warm is not None:
        first = np.where(reached, layout.flat(np.moveaxis(never - _values_of(warm, grid), -1, 0)), 0.0)
        arrival, residual, done = run(first, min(config.warm_sweeps, config.max_sweeps))
    if warm is None or residual >= config.tolerance:
        arrival, residual, count = run(np.zeros(flat_goal.shape, np.float32), config.max_sweeps)
        done += count

    values = np.float32(never) - np.moveaxis(layout.cells(arrival), 0, -1)
    cost_to_go = CostToGo(
        values=jnp.asarray(values),
        origin=jnp.asarray(grid.arena.origin, jnp.float32),
        resolution=jnp.float32(grid.arena.resolution),
        gamma=config.gamma,
        motion_length=grid.motions.length,
        counts=grid.counts,
    )
    status = ValueStatus.CONVERGED if residual < config.tolerance else ValueStatus.NOT_CONVERGED
    return ValueResult(status, cost_to_go, residual, done, time.perf_counter() - began, free, unreachable)


def _vector(field: str, value: np.ndarray, sizes: tuple[int, ...]) -> np.ndarray:
    """Return a vector that is finite and of one of the sizes, else raise :class:`InputError`."""
    vector = np.asarray(value, dtype=np.float64)
    if vector.ndim != 1 or len(vector) not in sizes or not np.isfinite(vector).all():
        names = " or ".join("(x, y)" if n == 2 else "(x, y, heading)" for n in sizes)
        raise InputError("value iteration", field, f"finite {names}; found {value!r:.80}")
    return vector


def _values_of(warm: CostToGo, grid: PoseGrid) -> np.ndarray:
    """Return the values of a cost-to-go on the same grid with the same discount, else raise :class:`InputError`."""
    same = (
        warm.values.shape == grid.blocked.shape
        and np.allclose(warm.origin, grid.arena.origin, atol=1e-3 * grid.arena.resolution)
        and warm.gamma == grid.config.gamma
    )
    if not same:
        raise InputError("value iteration", "warm", "a cost-to-go on the same grid with the same discount")
    return np.asarray(warm.values)


def _around(reached: np.ndarray, grid: PoseGrid, planar: np.ndarray) -> np.ndarray:
    """Return the flags ``(n_headings, nx, ny)`` of the poses next to ``planar``, up to ``(3, 3, 3)``."""
    x, y = np.round((planar[:2] - grid.arena.origin) / grid.arena.resolution).astype(int)
    n = len(reached)
    k = int(np.round(planar[2] * n / (2.0 * np.pi)))
    near = [slice(max(0, c - 1), max(0, c + 2)) for c in (x, y)]
    return reached[[(k + d) % n for d in (-1, 0, 1)]][:, near[0], near[1]]
