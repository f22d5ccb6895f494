"""Test planning by weights: searches against Dijkstra, shortening as descent, detours around what costs more."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tests.helpers.box_rooms import ROOM
from tests.helpers.planning_worlds import clearance_map
from vssm_gym.geometry.grid_graph import LENGTHS, MOVES, edge_free
from vssm_gym.planning.clearance import UNIFORM, ClearanceMap
from vssm_gym.planning.grid_search.astar import search
from vssm_gym.planning.grid_search.clearance_requirement import path_free, requirement_from
from vssm_gym.planning.grid_search.path_cost import path_cost, segment_cost
from vssm_gym.planning.grid_search.path_shortening import shorten_path
from vssm_gym.planning.planners import PLANNERS, Planner
from vssm_gym.planning.result import PlanStatus

RADIUS = 0.1  # m
EMPTY = clearance_map(ROOM, shapely.Polygon())


def weighted(weight: np.ndarray) -> ClearanceMap:
    return ClearanceMap(EMPTY.clearance, EMPTY.origin, EMPTY.resolution, weight.astype(np.float32))


def patch(cost: float) -> ClearanceMap:
    """Return an empty room with a square in its middle where a metre costs ``cost``."""
    weight = np.ones(EMPTY.clearance.shape)
    n, m = weight.shape
    weight[n // 3 : 2 * n // 3, m // 3 : 2 * m // 3] = cost
    return weighted(weight)


@pytest.fixture(params=PLANNERS)
def planner(request: pytest.FixtureRequest) -> Planner:
    return PLANNERS[request.param]


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.4))
def test_astar_costs_as_much_as_dijkstra(seed, density):
    rng = np.random.default_rng(seed)
    free = rng.random((9, 11)) >= density
    start, goal = (0, 0), (8, 10)
    free[start] = free[goal] = True
    weight = rng.uniform(1.0, 4.0, free.shape).astype(np.float32)
    rows, columns, costs = [], [], []
    for i, j in np.argwhere(free).tolist():
        for (di, dj), length in zip(MOVES.tolist(), LENGTHS.tolist(), strict=True):
            if edge_free(free.astype(np.uint8), i, j, di, dj):
                rows.append(i * 11 + j)
                columns.append((i + di) * 11 + j + dj)
                costs.append(length * 0.5 * (weight[i, j] + weight[i + di, j + dj]))
    graph = coo_array((costs, (rows, columns)), shape=(99, 99)).tocsr()
    exact = dijkstra(graph, indices=0)[98]
    found = search(free.astype(np.uint8), weight, np.array([[0, 0, 0.0]]), 8.0, 10.0, 0.0, 10_000)
    assert found[2] == pytest.approx(exact, rel=1e-6)


@given(st.lists(st.floats(0.0, 20.0), min_size=4, max_size=4), st.floats(1.0, 9.0))
def test_a_constant_weight_is_a_factor_of_the_length(ends, w):
    length = math.hypot(ends[2] - ends[0], ends[3] - ends[1])
    assert segment_cost(UNIFORM, *ends) == pytest.approx(length)
    assert segment_cost(np.full((22, 22), w, np.float32), *ends) == pytest.approx(w * length, rel=1e-5, abs=1e-9)


def test_the_cost_of_a_segment_is_the_integral_of_a_linear_weight():
    """w = 1 + x: from x = 2 to x = 10 it costs 8 + (100 - 4) / 2 cells."""
    weight = np.broadcast_to(1.0 + np.arange(16.0)[:, None], (16, 8)).astype(np.float32)
    assert segment_cost(weight, 2.0, 3.0, 10.0, 3.0) == pytest.approx(8.0 + 48.0, rel=1e-6)


def test_a_path_goes_around_what_costs_more_than_the_way_around(planner):
    start, goal = np.array([0.5, 2.0]), np.array([4.5, 2.0])
    straight = planner(start, goal, EMPTY, RADIUS)
    dear, cheap = patch(6.0), patch(1.02)
    around = planner(start, goal, dear, RADIUS)
    assert around.status is PlanStatus.FOUND
    assert straight.cost == pytest.approx(4.0, rel=0.01)
    through = dear.resolution * path_cost(dear.weights, dear.to_grid(straight.path))
    assert around.cost < 0.75 * through
    assert around.cost == pytest.approx(dear.resolution * path_cost(dear.weights, dear.to_grid(around.path)), rel=1e-6)
    assert planner(start, goal, cheap, RADIUS).cost == pytest.approx(straight.cost, rel=0.02)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_shortening_never_costs_more_and_stays_free(seed):
    rng = np.random.default_rng(seed)
    boxes = [shapely.box(x, y, x + 0.5, y + 0.6) for x, y in rng.uniform(0.5, 3.5, (3, 2))]
    plain = clearance_map(ROOM, shapely.union_all(boxes))
    coarse = rng.uniform(1.0, 3.0, tuple(n // 12 + 1 for n in plain.clearance.shape))
    weight = np.kron(coarse, np.ones((12, 12)))[: plain.clearance.shape[0], : plain.clearance.shape[1]]
    space = ClearanceMap(plain.clearance, plain.origin, plain.resolution, weight.astype(np.float32))
    free = np.argwhere(plain.clearance > RADIUS + 0.05)
    start, goal = space.to_world(rng.choice(free, 2))
    nodes = PLANNERS["theta_star"](start, goal, space, RADIUS)
    if not nodes.found:
        return
    required = requirement_from(space, start, RADIUS)
    shorter = shorten_path(space, nodes.path, nodes.path[-1], 0.0, required)
    assert shorter is not None
    before, after = (path_cost(space.weights, space.to_grid(path)) for path in (nodes.path, shorter))
    assert after <= before + 1e-6
    assert path_free(space.clearance, space.resolution, space.to_grid(shorter), required)
