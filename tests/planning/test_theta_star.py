"""Test Theta* against A*'s paths with and without shortening, against lines of sight, and at one corner by hand."""

import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings

from tests.helpers.box_rooms import ROOM, layouts, seeds
from tests.helpers.planning_worlds import clearance_map
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.grid_search import astar
from vssm_gym.planning.grid_search.clearance_requirement import requirement_from, segment_free
from vssm_gym.planning.grid_search.theta_star import plan

RADIUS = 0.1  # m


def scene(obstacles: list[shapely.Polygon], seed: int) -> tuple[ClearanceMap, np.ndarray, np.ndarray]:
    """Generate a random room with a start and a goal that both have room for the robot."""
    plan_map = clearance_map(ROOM, shapely.union_all(obstacles))
    free = np.argwhere(plan_map.clearance > RADIUS + 0.06)
    rng = np.random.default_rng(seed)
    start, goal = plan_map.to_world(rng.choice(free, 2)) + rng.uniform(-0.01, 0.01, (2, 2))
    return plan_map, start, goal


@pytest.mark.slow
@settings(max_examples=20)
@given(layouts, seeds)
def test_the_length_lies_between_the_shortened_and_the_grid_path(obstacles, seed):
    """It is no longer than A*'s path over the grid's edges, and within 2 % and a cell of the shortened one."""
    plan_map, start, goal = scene(obstacles, seed)
    result = plan(start, goal, plan_map, RADIUS)
    shortened = astar.plan(start, goal, plan_map, RADIUS)
    edges = astar.plan(start, goal, plan_map, RADIUS, any_angle=False)
    assert result.status is shortened.status
    if not result.found:
        assert result.cost == math.inf
        return
    assert result.cost <= edges.cost + 1e-6
    assert result.cost <= 1.02 * shortened.cost + plan_map.resolution


@pytest.mark.slow
@settings(max_examples=20)
@given(layouts, seeds)
def test_bends_at_obstacles_only(obstacles, seed):
    """Every bend lies within four cells of a place in collision, and the segment between two bends is free."""
    plan_map, start, goal = scene(obstacles, seed)
    result = plan(start, goal, plan_map, RADIUS)
    path, required = plan_map.to_grid(result.path), requirement_from(plan_map, start, RADIUS)
    for a, b in itertools.pairwise(path):
        assert segment_free(plan_map.clearance, plan_map.resolution, *a, *b, required) or np.hypot(*(b - a)) < 2.3
    for before, bend, after in zip(path[:-3], path[1:-2], path[2:-1], strict=True):  # the goal's cell is left out
        one, two = bend - before, after - bend
        if abs(math.atan2(one[0] * two[1] - one[1] * two[0], one @ two)) > 0.05:
            assert plan_map.at(plan_map.to_world(bend)) <= RADIUS + 4.0 * plan_map.resolution


def test_without_obstacles_the_path_is_a_straight_line():
    room = clearance_map(ROOM, shapely.Point(9.0, 9.0).buffer(0.1))
    start, goal = np.array([0.512, 0.537]), np.array([4.391, 2.846])
    result = plan(start, goal, room, RADIUS)
    straight = float(np.linalg.norm(goal - start))
    assert result.cost <= straight + room.resolution**2 / straight + 0.5 * room.resolution
    assert len(result.path) <= 3  # the last node, then the goal in its cell


def test_round_one_corner_by_hand():
    """Past a thin wall that ends at y = 2 the path is two tangents to a circle and the arc between them."""
    floor = shapely.box(0.0, 0.0, 3.0, 3.0)
    plan_map = clearance_map(floor, shapely.box(1.4999, 0.0, 1.5001, 2.0), 0.02)
    result = plan(np.array([0.5, 1.0]), np.array([2.5, 1.0]), plan_map, RADIUS)
    to_corner = math.sqrt(2.0)
    tangent = math.sqrt(to_corner**2 - RADIUS**2)
    exact = 2.0 * tangent + RADIUS * (1.5 * math.pi - 2.0 * math.acos(RADIUS / to_corner))
    assert exact == pytest.approx(2.9926, abs=1e-4)
    assert exact - 0.005 <= result.cost <= 1.015 * exact
    assert result.path[:, 1].max() >= 2.0 + RADIUS - 0.01
