"""Test value iteration against an exact dynamic program, and its laws: Bellman, walls, symmetry, warm starts."""

import itertools

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import shapely
from hypothesis import given, settings

from tests.helpers.mpc_worlds import linear_cost
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena, heading_grid, rectangle_collisions
from vssm_gym.planning.value_iteration import (
    Counts,
    Motions,
    PoseGrid,
    ValueConfig,
    ValueStatus,
    solve,
    sweeps,
)

CAR = Car()
SMALL = Car(wheelbase=0.05, track=0.04, length=0.09, width=0.05, rear_overhang=0.02, camera_forward=0.05)
RESOLUTION = 0.05
COARSE = ValueConfig(n_headings=16, turns=(-1, 0, 1))
NEVER = 100.0
SHAPE = (16, 12)  # one shape for all: one compilation


def arena_of(occupied: np.ndarray, resolution: float = RESOLUTION) -> Arena:
    return Arena.from_occupied(occupied, np.array([0.5, -1.0]), resolution)


def place(arena: Arena, i: float, j: float) -> np.ndarray:
    """Return the world position of continuous cell coordinates."""
    return arena.origin + arena.resolution * np.array([i, j])


def room(*boxes: tuple[int, int, int, int], shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Return walls with boxes ``(ix, jx, iy, jy)``, half-open, inside."""
    occupied = np.zeros(shape, bool)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    for a, b, c, d in boxes:
        occupied[a:b, c:d] = True
    return occupied


def values(result) -> np.ndarray:
    return np.asarray(result.cost_to_go.values, np.float64)


def exact(arena: Arena, car: Car, config: ValueConfig, at_goal: np.ndarray, counts: Counts | None = None) -> np.ndarray:
    """Solve the same aggregation, built state by state in float64, by policy iteration.

    Motions forwards and backwards count as often as ``counts`` says, if it is given.

    Nothing of the solver is used but the numbers of its definition: arcs from a circle's geometry, collisions by
    polygons, transitions as a sparse matrix a motion.
    """
    nx, ny = arena.occupied.shape
    n = config.n_headings
    step = 2.0 * np.pi / n
    length = max(config.turns) * step * car.wheelbase / np.tan(car.max_steering)
    half = 0.5 * arena.resolution
    solid = [shapely.box(*(c - half), *(c + half)) for c in arena.resolution * np.argwhere(arena.occupied)]
    frame = shapely.box(-half, -half, (nx - 0.5) * arena.resolution, (ny - 0.5) * arena.resolution)
    obstacles = shapely.union_all([*solid, frame.buffer(2.0) - frame]).buffer(-1e-7)
    shapely.prepare(obstacles)

    motions = []  # for each motion and state: allowed, successors, weights
    states = np.array(list(itertools.product(range(nx), range(ny), range(n))))
    number = lambda i, j, k: (i * ny + j) * n + k
    for sign, turns in itertools.product((1, -1), config.turns):
        turn = sign * turns * step
        heading = states[:, 2] * step
        hit = np.zeros(len(states), bool)
        for share in np.linspace(0.0, 1.0, 41):
            angle = share * turn
            if turn == 0.0:
                x, y = sign * share * length * np.cos(heading), sign * share * length * np.sin(heading)
            else:
                radius = sign * length / turn
                x = radius * (np.sin(heading + angle) - np.sin(heading))
                y = -radius * (np.cos(heading + angle) - np.cos(heading))
            p = np.column_stack([states[:, :2] * arena.resolution + np.column_stack([x, y]), heading + angle])
            hit |= shapely.intersects(obstacles, shapely.polygons(car.corners(p)))
        cell = np.column_stack([x, y]) / arena.resolution
        cell = np.round(cell, 9) + states[:, :2]
        low = np.floor(cell).astype(int)
        fraction = cell - low
        matrix = scipy.sparse.csr_matrix((len(states), len(states) + 1))
        k = (states[:, 2] + sign * turns) % n
        for u, v in itertools.product((0, 1), (0, 1)):
            w = (fraction[:, 0] if u else 1 - fraction[:, 0]) * (fraction[:, 1] if v else 1 - fraction[:, 1])
            i, j = low[:, 0] + u, low[:, 1] + v
            inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
            column = np.where(inside, number(i, j, k), len(states))
            matrix += scipy.sparse.csr_matrix((w * ~hit, (np.arange(len(states)), column)), shape=matrix.shape)
        motions.append((hit, matrix))
    blocked = shapely.intersects(
        obstacles,
        shapely.polygons(car.corners(np.column_stack([states[:, :2] * arena.resolution, states[:, 2] * step]))),
    )
    goal = at_goal.reshape(-1)
    absorbing = blocked | goal
    fixed = np.append(np.where(goal, 0.0, 1.0 / (1.0 - config.gamma)), 1.0 / (1.0 - config.gamma))
    each = np.ones((2, len(states)))
    if counts is not None:
        each = np.where(counts.poses.reshape(-1), counts.number[:, None], 1.0)
    gammas = [config.gamma ** each[a // len(config.turns)] for a in range(len(motions))]  # by state: gamma^k
    costs = [(1.0 - g) / (1.0 - config.gamma) for g in gammas]
    policy = np.full(len(states), -1)  # -1: stand for ever
    while True:
        cost = np.where(
            goal,
            0.0,
            np.where(blocked | (policy < 0), 1.0 / (1.0 - config.gamma), np.choose(policy, costs, mode="clip")),
        )
        drives = lambda a: scipy.sparse.diags(gammas[a] * ((policy == a) & ~absorbing))
        chosen = sum(drives(a) @ matrix for a, (_, matrix) in enumerate(motions))
        cost = cost + chosen[:, -1].toarray()[:, 0] * fixed[-1]
        system = scipy.sparse.eye(len(states)) - chosen[:, :-1]
        value = scipy.sparse.linalg.spsolve(system.tocsc(), cost)
        extended = np.append(value, fixed[-1])
        q = np.stack(
            [
                np.where(hit, np.inf, c + g * (m @ extended))
                for (hit, m), c, g in zip(motions, costs, gammas, strict=True)
            ]
        )
        better = q.argmin(axis=0)
        improves = (q.min(axis=0) < value - 1e-9) & ~absorbing
        if not improves.any():
            return value.reshape(nx, ny, n)
        policy = np.where(improves, better, policy)


@pytest.fixture(scope="module")
def small_grid() -> PoseGrid:
    """Return a room with a wall, a passage and a closed corner."""
    occupied = room((6, 7, 0, 7), (11, 15, 7, 8), (11, 12, 8, 12))
    return PoseGrid.of(arena_of(occupied), SMALL, COARSE)


def test_agrees_with_an_exact_dynamic_program(small_grid):
    goal = place(small_grid.arena, 3.2, 3.0)
    result = solve(small_grid, goal, radius=0.06)
    at_goal = small_grid.goal_poses(goal, 0.06, 0.0)
    expected = exact(small_grid.arena, SMALL, COARSE, at_goal)
    assert result.status is ValueStatus.CONVERGED
    assert result.unreachable > 0
    assert np.array_equal(values(result) == NEVER, expected > NEVER - 1e-7)
    # the residual bounds the error by 1 / (1 - gamma); where the goal is certain to be reached it is far smaller
    assert np.abs(values(result) - expected).max() < 0.02


def test_the_returned_residual_is_the_bellman_residual(small_grid):
    """The oracle is one more sweep in numpy, from the motions' definition."""
    result = solve(small_grid, place(small_grid.arena, 3.0, 3.0), radius=0.06)
    grid, V = small_grid, values(result)
    arcs = grid.motions.collisions(grid.arena.occupied, RESOLUTION, 0.0)
    q = []
    for a in range(arcs.shape[1]):
        ends = grid.motions.along(np.array(1.0))[:, a]  # by heading
        i, j, k = np.meshgrid(*(np.arange(m) for m in V.shape), indexing="ij")
        planar = np.stack([i * RESOLUTION + ends[k, 0], j * RESOLUTION + ends[k, 1], ends[k, 2]], axis=-1)
        planar[..., :2] += grid.arena.origin
        after = sum(weight * V[index] for index, weight in result.cost_to_go._corners(planar)[0])
        q.append(np.where(np.moveaxis(arcs[:, a], 0, -1), NEVER, 1.0 + 0.99 * after))
    backed_up = np.where(grid.goal_poses(place(grid.arena, 3.0, 3.0), 0.06, 0.0), 0.0, np.min(q, axis=0))
    inner = np.s_[2:-2, 2:-2]  # the query knows nothing between the outermost cell centres and the border
    assert result.residual < 1e-3
    assert np.abs(backed_up - V)[inner].max() < 1e-3 + 1e-4  # and float32


def test_zero_at_the_goal_and_nowhere_else(small_grid):
    goal = place(small_grid.arena, 3.0, 3.0)
    V = values(solve(small_grid, goal, radius=0.06))
    at_goal = small_grid.goal_poses(goal, 0.06, 0.0)
    assert np.all(V[at_goal] == 0.0)
    assert V[~at_goal].min() >= 0.99  # a motion
    assert np.all(V[small_grid.blocked] == NEVER)


def test_the_value_depends_on_the_heading(small_grid):
    arena = small_grid.arena
    pose = np.array([*place(arena, 3.0, 3.0), np.pi])
    at_goal = small_grid.goal_poses(pose, 0.06, np.radians(15.0))
    assert np.flatnonzero(at_goal.any(axis=(0, 1))).tolist() == [8]
    as_point, as_pose = (values(solve(small_grid, g, radius=0.06)) for g in (pose[:2], pose))
    assert np.all(as_pose >= as_point - 1e-3)
    assert as_pose[3, 3, 8] == 0.0
    assert as_pose[3, 3, 0] > 1.0


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1))
def test_more_obstacles_never_cost_less(seed):
    rng = np.random.default_rng(seed)
    fewer = room() | (rng.random(SHAPE) < 0.05)
    more = fewer | (rng.random(SHAPE) < 0.05)
    fewer[2:5, 2:5] = more[2:5, 2:5] = False
    grids = [PoseGrid.of(arena_of(o), SMALL, COARSE) for o in (fewer, more)]
    goal = place(grids[0].arena, 3, 3)
    a, b = (solve(g, goal, radius=0.06) for g in grids)
    if b.status is ValueStatus.CONVERGED:
        at_both = grids[0].goal_poses(goal, 0.06, 0.0) == grids[1].goal_poses(goal, 0.06, 0.0)
        assert np.all((values(b) >= values(a) - 0.01)[at_both])


def test_mirrored_world_has_mirrored_values(small_grid):
    """Reflection in the x axis maps y to -y and heading to -heading."""
    arena = small_grid.arena
    mirrored = PoseGrid.of(Arena.from_occupied(arena.occupied[:, ::-1], arena.origin, RESOLUTION), SMALL, COARSE)
    here = solve(small_grid, place(arena, 3.0, 3.0), radius=0.06)
    there = solve(mirrored, place(arena, 3.0, SHAPE[1] - 1 - 3.0), radius=0.06)
    reflected = values(there)[:, ::-1][:, :, -np.arange(COARSE.n_headings) % COARSE.n_headings]
    # A wall met within rounding may be hit on one side only: no such case in this room
    assert np.abs(values(here) - reflected).max() < 0.01


def test_backwards_equals_forwards_with_the_car_reversed():
    """A car with its rear axle in its middle is symmetric."""
    middle = Car(wheelbase=0.045, track=0.04, length=0.09, width=0.05, rear_overhang=0.045, camera_forward=0.05)
    grid = PoseGrid.of(arena_of(room((6, 7, 0, 7))), middle, COARSE)
    V = values(solve(grid, place(grid.arena, 3, 3), radius=0.06))
    assert np.abs(V - np.roll(V, COARSE.n_headings // 2, axis=2)).max() < 1e-3


def test_a_sealed_room_has_the_full_cost_and_needs_no_more_sweeps():
    shut, open_ = room((9, 10, 0, 12)), room((9, 10, 0, 5))
    results = {}
    for name, occupied in (("shut", shut), ("open", open_)):
        grid = PoseGrid.of(arena_of(occupied), SMALL, COARSE)
        results[name] = solve(grid, place(grid.arena, 4, 6), radius=0.06)
        free = ~grid.blocked
    behind = free[10:].sum()
    assert results["shut"].unreachable >= behind
    assert np.all(values(results["shut"])[10:] == NEVER)
    assert results["open"].unreachable < 0.2 * behind
    assert results["shut"].sweeps <= results["open"].sweeps


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8])
def test_no_value_passes_through_a_wall(angle):
    """Behind a wall one cell thick that encloses the goal every pose has the full cost, those beside it too."""
    x, y = np.meshgrid(np.arange(24) - 11.5, np.arange(24) - 11.5, indexing="ij")
    along = np.cos(angle) * x + np.sin(angle) * y
    occupied = room(shape=(24, 24)) | (np.abs(along) <= 0.5 * (np.cos(angle) + np.sin(angle)))
    grid = PoseGrid.of(arena_of(occupied), SMALL, COARSE)
    across = np.array([np.cos(angle), np.sin(angle)])
    goal, behind = place(grid.arena, *(11.5 - 6.0 * across)), place(grid.arena, *(11.5 + 5.0 * across))
    result = solve(grid, goal, radius=0.06)
    V = values(result)
    assert np.all(V[along > 0.0] == NEVER)
    assert (V[along < 0.0] < NEVER).mean() > 0.3
    behind = np.array([*behind, 0.0])
    assert solve(grid, goal, start=behind).status is ValueStatus.UNREACHABLE
    assert not result.cost_to_go.reachable(behind)


@pytest.mark.parametrize("change", ["goal", "nothing", "box added", "box removed", "door shut"])
def test_warm_start_reaches_the_same_fixed_point(change):
    box, door = (10, 12, 3, 5), (6, 7, 0, 8)
    before = room(door, *([box] if change == "box removed" else []))
    after = room((6, 7, 0, 12) if change == "door shut" else door, *([box] if change == "box added" else []))
    old, new = (PoseGrid.of(arena_of(o), SMALL, COARSE) for o in (before, after))
    goal = place(new.arena, 3, 4) if change == "goal" else place(new.arena, 3, 3)
    warm = solve(new, goal, radius=0.06, warm=solve(old, place(old.arena, 3, 3), radius=0.06).cost_to_go)
    cold = solve(new, goal, radius=0.06)
    assert warm.residual < 1e-3
    assert warm.unreachable == cold.unreachable
    assert np.array_equal(values(warm) == NEVER, values(cold) == NEVER)
    assert np.abs(values(warm) - values(cold)).max() < 0.02
    if change in ("nothing", "goal", "door shut"):  # what the door shut off starts where it ends
        assert warm.sweeps <= cold.sweeps


def test_motions_that_count_several_times_cost_so_and_close_nothing():
    """From each pose over some cells a motion counts k times, so that its discount is gamma^k."""
    occupied, unknown = room((6, 7, 0, 7)), np.zeros(SHAPE, bool)
    unknown[5:8, 7:11] = True  # the passage
    over = rectangle_collisions(unknown, RESOLUTION, SMALL, heading_grid(16))
    counts = [Counts(over, np.array(number, np.float32)) for number in ((1.0, 1.0), (2.0, 3.0))]
    grids = [PoseGrid.of(arena_of(occupied), SMALL, COARSE, each) for each in counts]
    plain = PoseGrid.of(arena_of(occupied), SMALL, COARSE)
    goal = place(plain.arena, 3, 3)
    known, as_known, dear = (values(solve(grid, goal, radius=0.06)) for grid in (plain, *grids))
    np.testing.assert_allclose(as_known, known, atol=2e-3)
    np.testing.assert_array_equal(dear == NEVER, known == NEVER)
    assert (dear >= known - 2e-3).all()
    behind = (np.arange(SHAPE[0]) > 8)[:, None, None] & (known < NEVER)
    assert behind.any() and (dear[behind] > known[behind] + 1.0).all()
    expected = exact(plain.arena, SMALL, COARSE, plain.goal_poses(goal, 0.06, 0.0), counts[1])
    assert np.abs(dear - expected).max() < 0.02


@pytest.mark.parametrize("number", [(3.0,), 3.0, (3.0, 0.5), (np.nan, 3.0), (np.inf, 3.0)])
def test_numbers_that_are_no_counts_are_refused(number):
    counts = Counts(np.zeros((*SHAPE, 16), bool), np.array(number))
    with pytest.raises(InputError, match=r"counts\.number: expected two finite numbers from 1"):
        PoseGrid.of(arena_of(room()), SMALL, COARSE, counts)


@pytest.mark.parametrize("poses", [np.zeros((*SHAPE, 15), bool), np.zeros((*SHAPE, 16), np.float32)])
def test_poses_of_another_grid_or_type_are_refused(poses):
    with pytest.raises(InputError, match=r"counts\.poses: expected bool of shape"):
        PoseGrid.of(arena_of(room()), SMALL, COARSE, Counts(poses, np.ones(2)))


def test_compiles_once_for_all_goals_and_maps(small_grid):
    solve(small_grid, place(small_grid.arena, 3, 3), radius=0.06)
    compiled = len(sweeps._iterate.signatures)
    result = None
    for occupied in (room(), room((6, 7, 0, 7))):
        grid = PoseGrid.of(arena_of(occupied), SMALL, COARSE)
        for i, j in ((3, 3), (4, 6), (10, 4)):
            warm = result.cost_to_go if result else None
            result = solve(grid, np.array([*place(grid.arena, i, j), 0.3]), radius=0.1, warm=warm)
            assert result.solved
    assert len(sweeps._iterate.signatures) == compiled


def test_refusals_have_their_reason(small_grid):
    arena = small_grid.arena
    inside_wall, closed, open_ = place(arena, 0, 5), place(arena, 13, 9.5), place(arena, 3, 3)
    refused = {
        ValueStatus.GOAL_BLOCKED: solve(small_grid, inside_wall, radius=0.01),
        ValueStatus.START_BLOCKED: solve(small_grid, open_, start=np.array([*inside_wall, 0.0])),
        ValueStatus.UNREACHABLE: solve(small_grid, closed, radius=0.06, start=np.array([*open_, 0.0])),
    }
    for status, result in refused.items():
        assert result.status is status
        assert result.cost_to_go is None
        assert result.sweeps == 0
        assert not result.solved
    assert solve(small_grid, open_, start=np.array([*place(arena, 10, 3), 0.0])).solved


def test_too_few_sweeps_are_reported():
    grid = PoseGrid.of(arena_of(room()), SMALL, ValueConfig(n_headings=16, turns=(-1, 0, 1), max_sweeps=4))
    result = solve(grid, place(grid.arena, 3, 3), radius=0.06)
    assert result.status is ValueStatus.NOT_CONVERGED
    assert result.residual >= 1e-3
    assert result.sweeps == 4


def test_a_post_between_start_and_end_of_an_arc_stops_it():
    """Both ends are free and the middle is not; a car shorter than its motions must not pass through a post."""
    occupied = np.zeros((60, 21), bool)
    occupied[20, 10] = True
    motions = Motions.of(SMALL, 16, (-6, 0, 6))
    assert motions.length > SMALL.length + 2 * 0.02
    arcs = motions.collisions(occupied, 0.02, 0.0)
    ahead = 1  # straight on, heading 0
    crossing = [i for i in range(5, 40) if arcs[0, ahead, i, 10]]
    first, last = crossing[0], crossing[-1]
    assert crossing == list(range(first, last + 1))
    assert last - first + 1 == pytest.approx((motions.length + SMALL.length) / 0.02, abs=1.5)


@pytest.mark.parametrize(
    "call",
    [
        lambda g: solve(g, np.array([0.0])),
        lambda g: solve(g, np.array([0.0, np.nan])),
        lambda g: solve(g, np.array([1.0, 0.0]), start=np.array([1.0, 0.0])),
        lambda g: solve(g, place(g.arena, 3, 3), warm=linear_cost()),
        lambda g: ValueConfig(gamma=1.0),
        lambda g: ValueConfig(tolerance=1e-6),
        lambda g: ValueConfig(margin=-0.1),
        lambda g: ValueConfig(max_sweeps=0),
        lambda g: Motions.of(CAR, 4),
        lambda g: Motions.of(CAR, 64, (0,)),
        lambda g: Motions.of(CAR, 64, (1, 1)),
        lambda g: Motions.of(CAR, 64, tuple(range(16))),
    ],
)
def test_bad_input_is_named(small_grid, call):
    with pytest.raises(InputError):
        call(small_grid)
