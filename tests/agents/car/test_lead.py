"""Test that a car is led along routes: arcs join poses, and the path is followed to its end."""

from functools import partial
from itertools import pairwise

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from vssm_gym.agents.shared.car.lead import ASTRAY, Lead, Leader
from vssm_gym.agents.shared.car.recovery import CREEP_SPEED, Failure
from vssm_gym.geometry.arc import arc_between, poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED

CAR = Car()


def after(start: np.ndarray, length: float, steering: float) -> np.ndarray:
    turn = turn_of(np.array(length), steering, CAR.wheelbase)
    return poses_after(start[2], np.array(length), turn, start[0], start[1])


@given(
    st.floats(-3.0, 3.0),
    st.floats(-CAR.max_steering, CAR.max_steering),
    st.floats(0.01, 0.4),
    st.sampled_from([1.0, -1.0]),
)
def test_the_arc_between_two_poses_is_the_one_that_was_driven(heading, steering, length, sign):
    start = np.array([1.0, -2.0, heading])
    found = arc_between(start, after(start, sign * length, steering), CAR.wheelbase)
    np.testing.assert_allclose(found, [sign * length, steering], atol=1e-6)


ROUTES = {
    "straight": [(0.3, 0.0)],
    "back": [(-0.26, 0.3)],
    "a turn in three moves": [(0.26, CAR.max_steering), (-0.26, -CAR.max_steering), (0.26, CAR.max_steering)],
}


@pytest.mark.parametrize("name", ROUTES)
def test_a_route_is_followed_to_its_end(name):
    """A car that executes its commands exactly ends within 3 cm and 10 degrees, creeping all the while."""
    poses = [np.array([0.4, -0.2, 0.7])]
    for length, steering in ROUTES[name]:
        poses += [after(poses[-1], 0.5 * length, steering)]
        poses += [after(poses[-1], 0.5 * length, steering)]
    lead, at, driven = Lead(np.array(poses), CAR), poses[0], [poses[0]]
    for _ in range(100):
        command = lead.step(at)
        if command is None:
            break
        assert abs(command[0]) <= CREEP_SPEED
        at = after(at, command[0] * CAR.dt, command[1])
        driven.append(at)
    assert command is None
    off = at - poses[-1]
    assert np.hypot(*off[:2]) < 0.03 and abs(off[2]) < np.radians(10.0)
    length = sum(float(np.hypot(*(b - a)[:2])) for a, b in pairwise(driven))
    assert length < 1.1 * sum(abs(one) for one, _ in ROUTES[name])


def test_a_car_away_from_its_route_is_led_no_more():
    lead = Lead(np.array([[0.0, 0.0, 0.0], [0.13, 0.0, 0.0]]), CAR)
    assert lead.step(np.array([0.02, 0.9 * ASTRAY, 0.0])) is not None
    assert lead.step(np.array([0.02, 1.5 * ASTRAY, 0.0])) is None


CELL = 0.04
ROUTE = np.array([[0.0, 0.0, 0.0], [0.13, 0.0, 0.0], [0.26, 0.0, 0.0]])


def plan(*occupied: tuple[float, float]) -> FloorPlan:
    """Return a free plan of 4 x 4 m about the origin but for some cells."""
    cells, origin = np.full((101, 101), FREE, np.int8), np.array([-2.0, -2.0])
    for place in occupied:
        cells[tuple(np.round((np.array(place) - origin) / CELL).astype(int))] = OCCUPIED
    occupancy = np.where(cells == OCCUPIED, CELL, -CELL).astype(np.float32)
    return FloorPlan(cells, occupancy, origin, CELL)


def test_a_car_is_led_where_it_hesitates_and_where_its_plan_leads_nowhere_twice():
    leader, at = Leader(CAR), ROUTE[0]
    commanded = lambda: leader.step(at, plan, lambda planar: ROUTE) is not None
    leader.failed(Failure.UNSEEN, hesitates=False)
    assert not commanded()
    leader.failed(Failure.UNSEEN, hesitates=True)
    assert commanded() and commanded()
    leader.stop()
    assert not commanded()
    leader.failed(Failure.HELD, hesitates=False)
    assert not commanded()
    leader.failed(Failure.HELD, hesitates=False)
    assert commanded()
    leader.failed(Failure.UNSEEN, hesitates=False)  # another failure ends it
    assert not commanded()


def test_a_car_that_is_not_led_reads_no_floor_plan():
    asked = []
    assert Leader(CAR).step(ROUTE[0], lambda: asked.append(1) or plan(), lambda planar: ROUTE) is None
    assert not asked


def test_a_car_without_a_route_is_not_led():
    leader = Leader(CAR)
    leader.failed(Failure.UNSEEN, hesitates=True)
    assert leader.step(ROUTE[0], plan, lambda planar: None) is None
    assert leader.step(ROUTE[0], plan, lambda planar: ROUTE) is None  # it is asked for once


def test_an_obstacle_ahead_ends_the_lead_and_one_under_the_car_does_not():
    nose = CAR.length - CAR.rear_overhang
    for occupied, led in [((nose + 0.03, 0.0), False), ((nose + 0.3, 0.0), True), ((0.1, 0.0), True)]:
        leader = Leader(CAR)
        leader.failed(Failure.UNSEEN, hesitates=True)
        assert (leader.step(ROUTE[0], partial(plan, occupied), lambda planar: ROUTE) is not None) == led
    leader = Leader(CAR)
    leader.failed(Failure.UNSEEN, hesitates=True)
    both = plan((0.1, 0.0), (nose + 0.03, 0.0))
    assert leader.step(ROUTE[0], lambda: both, lambda planar: ROUTE) is None
