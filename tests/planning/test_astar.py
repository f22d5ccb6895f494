"""Test A* against Dijkstra on an independently built graph, and the any-angle path against a visibility graph."""

import itertools
import math

import hypothesis.strategies as st
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tests.helpers.box_rooms import ROOM, free_space, layouts, seeds
from tests.helpers.planning_worlds import clearance_map, grids
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.planning.clearance import UNIFORM, ClearanceMap
from vssm_gym.planning.grid_search.astar import plan, search
from vssm_gym.planning.grid_search.clearance_requirement import requirement_from
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.result import PlanStatus

RADIUS = 0.1  # m
MOVES = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if math.gcd(i, j) == 1]


def cells_under(move: tuple[int, int]) -> set[tuple[int, int]]:
    """Return the cells with a bilinear weight somewhere along a move from (0, 0), by brute force."""
    cells = set()
    for t in np.linspace(0.0, 1.0, 61):
        x, y = t * move[0], t * move[1]
        for i in {math.floor(x + 1e-9), math.ceil(x - 1e-9)}:
            cells |= {(i, j) for j in (math.floor(y + 1e-9), math.ceil(y - 1e-9))}
    return cells


UNDER = {move: cells_under(move) for move in MOVES}


def distances(free: np.ndarray, start: tuple[int, int]) -> np.ndarray:
    """Return Dijkstra's costs from ``start`` over the graph of all free moves, ``(nx, ny)``, in cells."""
    nodes = {(int(i), int(j)) for i, j in np.argwhere(free)}
    index = {node: k for k, node in enumerate(sorted(nodes))}
    rows, columns, lengths = [], [], []
    for i, j in nodes:
        for move in MOVES:
            if all((i + a, j + b) in nodes for a, b in UNDER[move]):
                rows.append(index[i, j])
                columns.append(index[i + move[0], j + move[1]])
                lengths.append(math.hypot(*move))
    graph = coo_array((lengths, (rows, columns)), shape=(len(nodes), len(nodes))).tocsr()
    found = np.full(free.shape, np.inf)
    found[tuple(np.array(sorted(nodes)).T)] = dijkstra(graph, indices=index[start])
    return found


def length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def along(path: np.ndarray, spacing: float = 0.004) -> np.ndarray:
    """Return points along a polyline."""
    pieces = [path[:1]]
    for a, b in itertools.pairwise(path):
        n = 1 + int(np.linalg.norm(b - a) / spacing)
        pieces.append(a + (b - a) * np.linspace(0.0, 1.0, n + 1)[1:, None])
    return np.concatenate(pieces)


@settings(max_examples=200)
@given(grids(), seeds, st.floats(0.5, 3.0))
def test_cost_is_dijkstras(occupied, seed, radius):
    free = ~occupied
    if not free.any():
        return
    rng = np.random.default_rng(seed)
    start = tuple(int(v) for v in rng.choice(np.argwhere(free)))
    goal = rng.uniform(0.0, np.array(free.shape) - 1.0)
    i, j = np.indices(free.shape)
    exact = distances(free, start)[np.hypot(i - goal[0], j - goal[1]) <= radius].min(initial=np.inf)
    seed_row = np.array([[*start, 0.0]])
    code, path, cost, _ = search(free.astype(np.uint8), UNIFORM, seed_row, goal[0], goal[1], radius, 10_000)
    assert cost == pytest.approx(exact)
    assert (code == 0) == np.isfinite(exact)
    if code == 0:
        assert tuple(path[0]) == start
        assert np.hypot(*(path[-1] - goal)) <= radius
        assert length(path) == pytest.approx(cost)
        steps = np.diff(path, axis=0).astype(int)
        for (a, b), step in zip(path[:-1].astype(int), steps, strict=True):
            assert all(free[a + u, b + v] for u, v in UNDER[tuple(int(s) for s in step)])


def scene(obstacles: list[shapely.Polygon], seed: int) -> tuple[ClearanceMap, np.ndarray, np.ndarray]:
    """Generate a random room with a start and a goal that both have room for the robot."""
    plan_map = clearance_map(ROOM, shapely.union_all(obstacles))
    rng = np.random.default_rng(seed)
    free = np.argwhere(plan_map.clearance > RADIUS + 0.06)
    start, goal = plan_map.to_world(rng.choice(free, 2)) + rng.uniform(-0.01, 0.01, (2, 2))
    return plan_map, start, goal


@settings(max_examples=20)
@given(layouts, seeds, st.sampled_from([0.0, 0.03]), st.sampled_from([0.0, 0.4]))
def test_any_angle_path(obstacles, seed, margin, goal_radius):
    """The path is feasible, no longer than the grid's path, and no shorter than the straight line."""
    plan_map, start, goal = scene(obstacles, seed)
    result = plan(start, goal, plan_map, RADIUS, margin=margin, goal_radius=goal_radius)
    grid = plan(start, goal, plan_map, RADIUS, margin=margin, goal_radius=goal_radius, any_angle=False)
    assert result.status is grid.status
    if not result.found:
        assert result.path.shape == (0, 2)
        assert result.cost == np.inf
        return
    assert result.cost == pytest.approx(length(result.path))
    assert result.cost <= grid.cost + 1e-9
    assert result.cost >= np.linalg.norm(goal - start) - max(goal_radius, plan_map.resolution) - 1e-9
    assert np.array_equal(result.path[0], start) or np.allclose(result.path[0], start, atol=1e-9)
    assert np.linalg.norm(result.path[-1] - goal) <= max(goal_radius, plan_map.resolution) + 1e-9
    # Half a cell between the samples of the sight test: the clearance may dip by a little between them.
    assert (plan_map.at(along(result.path)) >= RADIUS + margin - 0.003).all()
    # A goal within reach of the first step leaves nothing between.
    assert (plan_map.at(along(grid.path[1:])) >= RADIUS + margin - 1e-6).all()


@settings(max_examples=20)
@given(layouts, seeds)
def test_no_bend_can_be_moved_to_shorten_the_path(obstacles, seed):
    """No displacement of a bend by 2 cm gives a shorter path with the required clearance."""
    plan_map, start, goal = scene(obstacles, seed)
    path = plan(start, goal, plan_map, RADIUS).path
    for i in range(1, len(path) - 1):
        for angle in np.arange(12) * math.pi / 6:
            moved = path[i - 1 : i + 2].copy()
            moved[1] += 0.02 * np.array([math.cos(angle), math.sin(angle)])
            if length(moved) < length(path[i - 1 : i + 2]) - 0.002:
                assert plan_map.at(along(moved)).min() < RADIUS + 0.002


@settings(max_examples=20)
@given(layouts, seeds)
def test_length_against_a_visibility_graph(obstacles, seed):
    """The length is between those of the shortest paths of a slightly thinner disc and, within 1 %, a thicker one."""
    plan_map, start, goal = scene(obstacles, seed)
    result = plan(start, goal, plan_map, RADIUS, goal_radius=0.4)
    thin = Geodesics(free_space(obstacles, RADIUS - 0.02)).length(start, goal, 0.4)
    thick = Geodesics(free_space(obstacles, RADIUS + 0.02)).length(start, goal, 0.4)
    assert result.cost >= thin - 1e-3
    assert result.cost <= 1.01 * thick + 0.01


def test_round_one_corner_by_hand():
    """Past a thin wall that ends at y = 2 the path is two tangents to a circle and the arc between them."""
    floor = shapely.box(0.0, 0.0, 3.0, 3.0)
    plan_map = clearance_map(floor, shapely.box(1.4999, 0.0, 1.5001, 2.0), 0.02)
    result = plan(np.array([0.5, 1.0]), np.array([2.5, 1.0]), plan_map, RADIUS)
    to_corner = math.sqrt(2.0)
    tangent = math.sqrt(to_corner**2 - RADIUS**2)
    wrapped = 1.5 * math.pi - 2.0 * math.acos(RADIUS / to_corner)  # 270 degrees less the two of the tangents
    exact = 2.0 * tangent + RADIUS * wrapped
    assert exact == pytest.approx(2.9926, abs=1e-4)
    assert exact - 0.005 <= result.cost <= 1.01 * exact


CUT = clearance_map(ROOM, shapely.box(2.4, 0.0, 2.6, 4.0))  # a wall from side to side


def test_a_missing_path_is_reported():
    result = plan(np.array([1.0, 1.0]), np.array([4.0, 1.0]), CUT, RADIUS)
    assert result.status is PlanStatus.NO_PATH
    assert "no path" in result.status.message
    assert result.expansions > 1000


def test_a_goal_without_a_free_place_is_reported():
    boxed = clearance_map(ROOM, shapely.box(2.0, 1.0, 4.0, 3.0))
    inside = np.array([3.0, 2.0])
    assert plan(np.array([1.0, 1.0]), inside, boxed, RADIUS, goal_radius=0.4).status is PlanStatus.GOAL_BLOCKED
    reached = plan(np.array([1.0, 1.0]), inside, boxed, RADIUS, goal_radius=1.2)
    assert reached.found
    assert np.linalg.norm(reached.path[-1] - inside) <= 1.2 + 1e-9


def test_a_start_deep_inside_an_obstacle_is_reported():
    boxed = clearance_map(ROOM, shapely.box(2.0, 1.0, 4.0, 3.0))
    assert plan(np.array([3.0, 2.0]), np.array([1.0, 1.0]), boxed, RADIUS).status is PlanStatus.START_BLOCKED
    assert plan(np.array([-9.0, 2.0]), np.array([1.0, 1.0]), boxed, RADIUS).status is PlanStatus.START_BLOCKED


def test_time_out_leads_towards_the_goal():
    start, goal = np.array([0.5, 0.5]), np.array([2.2, 3.5])
    result = plan(start, goal, CUT, RADIUS, max_expansions=40)
    assert result.status is PlanStatus.TIME_OUT
    assert not result.found
    assert result.expansions == 40
    assert np.linalg.norm(result.path[-1] - goal) < np.linalg.norm(start - goal)
    assert CUT.at(along(result.path)).min() >= RADIUS - 0.003


def test_already_there():
    result = plan(np.array([1.0, 1.0]), np.array([1.2, 1.0]), CUT, RADIUS, goal_radius=0.4)
    assert result.found
    assert result.cost == 0.0
    assert result.path.shape == (1, 2)


@given(st.floats(-0.05, 0.12), st.floats(0.3, 3.7))
def test_leaving_a_wall(room_left, y):
    """A robot at the wall, or inside it by an error of the estimate, leaves it monotonically without a detour."""
    start, goal = np.array([2.4 - room_left, y]), np.array([1.0, 2.0])
    result = plan(start, goal, CUT, RADIUS, margin=0.03)
    assert result.found
    assert result.cost <= np.linalg.norm(goal - start) + 0.05
    points = along(result.path)
    required = requirement_from(CUT, start, RADIUS + 0.03)
    asked = np.minimum(required.limit, required.base + 0.3 * np.linalg.norm(points - start, axis=1))
    assert np.all(CUT.at(points) >= asked - 0.003)
    assert np.all(points[:, 0] < 2.45)  # on the side of the wall where it stood


@settings(max_examples=20)
@given(layouts, seeds, st.floats(0.0, 1.0))
def test_following_a_plan(obstacles, seed, share):
    """From a place on its plan the path is no longer than the rest of the plan, with the same clearance."""
    plan_map, start, goal = scene(obstacles, seed)
    result = plan(start, goal, plan_map, RADIUS, margin=0.03, goal_radius=0.4)
    if not result.found or len(result.path) < 2:
        return
    ends = np.cumsum(np.linalg.norm(np.diff(result.path, axis=0), axis=1))
    k = int(np.searchsorted(ends, share * ends[-1]))  # the segment it is on
    a, b = result.path[k], result.path[k + 1]
    here = b + (a - b) * (ends[k] - share * ends[-1]) / np.linalg.norm(b - a)
    left = np.concatenate([here[None], result.path[k + 1 :]])
    required = requirement_from(plan_map, left[0], RADIUS + 0.015)
    followed = shorten_path(plan_map, left, goal, 0.4, required)
    assert followed is not None
    assert length(followed) <= length(left) + 1e-6
    assert np.allclose(followed[0], left[0])
    assert plan_map.at(along(followed)).min() >= RADIUS + 0.012


def test_a_plan_that_cannot_be_reached_is_given_up():
    """A robot that was pushed to the other side of a wall can reach no point of the old plan."""
    old = np.array([[4.0, 1.0], [4.5, 2.0], [4.0, 3.0]])
    assert shorten_path(CUT, old, np.array([4.0, 3.0]), 0.1, requirement_from(CUT, old[0], RADIUS)) is not None
    old[0] = 1.0, 1.0
    assert shorten_path(CUT, old, np.array([4.0, 3.0]), 0.1, requirement_from(CUT, old[0], RADIUS)) is None


def test_same_question_same_answer():
    world = clearance_map(ROOM, shapely.box(2.0, 0.0, 2.6, 2.5) | shapely.box(3.5, 1.5, 4.0, 4.0))
    answers = [plan(np.array([0.5, 0.5]), np.array([4.5, 3.5]), world, RADIUS, margin=0.03) for _ in range(2)]
    assert np.array_equal(answers[0].path, answers[1].path)
    assert answers[0].expansions == answers[1].expansions
