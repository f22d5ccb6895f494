"""Test what a metre costs in a floor plan that is known in part, and where unknown space may be crossed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vssm_gym.errors import InputError
from vssm_gym.maps.columns import level_distance
from vssm_gym.planning.floor_plan import FloorPlan, changed_cells
from vssm_gym.planning.near_distance import near_level_distance
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.planning.planners import plan as plan_path
from vssm_gym.planning.result import PlanStatus
from vssm_gym.planning.traversability import REACH, Body, TraversabilityConfig, of_plan

RESOLUTION, BODY = 0.07, Body(0.1, 0.02)


def half_known(wall: bool = False) -> FloorPlan:
    """Return a plan of 6 x 4 m whose right half is unknown, with or without a wall between the halves."""
    cells = np.full((86, 57), UNKNOWN, np.int8)
    cells[1:43, 1:-1] = FREE
    cells[[0, *([43] if wall else [])]] = OCCUPIED
    cells[:44, [0, -1]] = OCCUPIED
    occupancy = np.where(cells == OCCUPIED, 0.05, np.where(cells == FREE, -0.1, -np.inf)).astype(np.float32)
    return FloorPlan(cells, occupancy, np.zeros(2), RESOLUTION)


LEFT, RIGHT = np.array([1.0, 2.0]), np.array([5.0, 2.0])


@settings(max_examples=50, deadline=None)
@given(arrays(np.float64, (12, 9), elements=st.floats(-1.0, 1.0)), st.floats(0.1, 1.0))
def test_near_distances_are_the_distances_up_to_a_reach(depth, reach):
    exact, near = level_distance(depth, RESOLUTION), near_level_distance(depth, RESOLUTION, reach)
    np.testing.assert_allclose(near, np.clip(exact, -reach, reach), atol=1e-5)


def test_a_path_through_the_unknown_pays_for_it():
    config = TraversabilityConfig(unknown=0.5)
    space = of_plan(half_known(), RIGHT, BODY, config)
    result = plan_path(LEFT, RIGHT, space, BODY.radius)
    assert result.status is PlanStatus.FOUND
    unknown = 5.0 - 42.5 * RESOLUTION  # m of the straight path
    assert result.cost == pytest.approx(4.0 + 0.5 * unknown, rel=0.02)


def test_unknown_space_at_infinite_cost_is_occupied():
    space = of_plan(half_known(), RIGHT, BODY, TraversabilityConfig(unknown=math.inf))
    assert plan_path(LEFT, RIGHT, space, BODY.radius).status is not PlanStatus.FOUND
    assert np.all(space.weights < 4.0)


def test_a_wall_that_was_seen_holds():
    space = of_plan(half_known(wall=True), RIGHT, BODY, TraversabilityConfig())
    assert plan_path(LEFT, RIGHT, space, BODY.radius).status is not PlanStatus.FOUND


def test_the_weight_follows_its_law():
    """In the middle of a free room a metre costs 1; where the body just fits, 1 + a + b."""
    config = TraversabilityConfig(comfort=0.04, deviations=1.5, nearness=0.3, skin=0.03, contact=0.5)
    space = of_plan(half_known(), LEFT, BODY, config)
    spare = space.clearance - BODY.radius
    comfort = 0.04 + 1.5 * BODY.step_std
    law = 1.0 + 0.3 * np.clip(1 - spare / comfort, 0, 1) ** 2 + 0.5 * np.clip(1 - spare / 0.03, 0, 1)
    known = half_known().cells != UNKNOWN
    np.testing.assert_allclose(space.weights[known], law[known], rtol=1e-5)
    assert space.weights[20, 28] == 1.0
    assert space.clearance.max() <= REACH + 1e-6


def test_space_beyond_the_outline_costs_more():
    """The rectangle around all that is known holds the goal, too."""
    plan = half_known()
    near, far = (of_plan(plan, goal, BODY, TraversabilityConfig(unknown=0.4, outside=3.0)) for goal in (LEFT, RIGHT))
    assert near.weights[70, 28] == pytest.approx(1.0 + 1.2)
    assert far.weights[70, 28] == pytest.approx(1.0 + 0.4)


@pytest.mark.parametrize("field", ["comfort", "nearness", "unknown", "outside", "skin", "contact", "deviations"])
def test_a_negative_number_is_refused(field):
    with pytest.raises(InputError, match=field):
        TraversabilityConfig(**{field: -0.1})


def test_changed_cells_are_those_whose_state_differs():
    before = half_known()
    cells = before.cells.copy()
    cells[50, 20], cells[10, 10] = FREE, OCCUPIED
    after = FloorPlan(cells, before.occupancy, before.origin, RESOLUTION)
    assert {tuple(c) for c in changed_cells(before, after).tolist()} == {(50, 20), (10, 10)}
    assert len(changed_cells(after, after)) == 0


@pytest.mark.parametrize("shift", [(-3, -2), (4, 0), (-5, 6)])
def test_changes_are_found_where_plans_are_cut_differently(shift):
    """A plan that was cut elsewhere is unknown where it does not reach."""
    before = half_known()
    origin = before.origin + RESOLUTION * np.array(shift)
    cells = np.full(before.cells.shape, UNKNOWN, np.int8)
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            a, b = i + shift[0], j + shift[1]
            if 0 <= a < cells.shape[0] and 0 <= b < cells.shape[1]:
                cells[i, j] = before.cells[a, b]
    after = FloorPlan(cells, before.occupancy, origin, RESOLUTION)
    assert len(changed_cells(before, after)) == 0
