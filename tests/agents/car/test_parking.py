"""Test when a car brakes and stops: by its belief, standing, and never before it is certain."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.agents.shared.car.parking import Parking, ParkingConfig, ParkingRule
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.inference.status import Status

CAR, GOAL = Car(), np.array([1.0, 2.0, 0.5])
STAND, DRIVE = np.zeros(2), np.array([0.6, 0.0])


def at(x=1.0, y=2.0, heading=0.5, std=None, turn=0.0) -> Localization:
    covariance = None if std is None else np.diag([std**2, std**2, turn**2])
    return Localization(np.array([x, y, heading]), np.zeros(3), Status.OK, 0, covariance)


def parked(rule: ParkingRule, where: Localization, steps: int) -> list[Parking]:
    """Return what the rule says while the car stands at one estimate."""
    return [rule.step(where, STAND) for _ in range(steps)]


def test_it_brakes_first_and_stops_when_it_stands():
    assert parked(ParkingRule(CAR, GOAL), at(), 2) == [Parking.BRAKE, Parking.STOP]


def test_it_does_not_stop_while_it_rolls():
    rule = ParkingRule(CAR, GOAL)
    said = [rule.step(at(x=0.95 + 0.01 * k), STAND) for k in range(6)]
    assert said == [Parking.BRAKE] * 6
    assert rule.step(at(x=1.0), STAND) is Parking.STOP


def test_it_brakes_before_it_is_there():
    """From full speed it comes to rest 9 cm ahead at 2 m/s^2."""
    ahead = GOAL[:2] - 0.09 * np.array([np.cos(0.5), np.sin(0.5)])
    assert ParkingRule(CAR, GOAL).step(at(*ahead), DRIVE) is Parking.BRAKE
    assert ParkingRule(CAR, GOAL).step(at(*ahead), STAND) is Parking.DRIVE  # it would stay at the rim
    assert ParkingRule(CAR, GOAL).step(at(), DRIVE) is Parking.DRIVE


def test_at_the_rim_it_brakes_where_it_no_longer_comes_closer():
    rule = ParkingRule(CAR, GOAL)
    off = [0.09, 0.085, 0.08, 0.085]
    said = [rule.step(at(y=2.0 + d), STAND) for d in off]
    assert said == [Parking.DRIVE] * 3 + [Parking.BRAKE]


def test_it_says_where_it_waits_for_a_narrower_belief():
    """Held by nothing and led nowhere, it must not count as stuck there: it would back out, and wait anew."""
    rule = ParkingRule(CAR, GOAL)
    assert not rule.waits
    said = parked(rule, at(std=0.05), ParkingConfig().patience)
    assert rule.waits and set(said) == {Parking.DRIVE}
    assert Parking.TRUST in parked(rule, at(std=0.05), 4)
    rule.step(at(x=1.3), STAND)
    assert not rule.waits


@given(st.floats(0.0, 0.2), st.floats(0.0, 0.5), st.floats(0.0, 0.08), st.floats(0.0, 0.2))
def test_it_stops_if_and_only_if_its_belief_is_inside(away, off, std, turn):
    """2.5 standard deviations of position and heading lie in the region."""
    rule = ParkingRule(CAR, GOAL)
    said = parked(rule, at(x=1.0 + away, heading=0.5 - off, std=std, turn=turn), 12)
    miss = max((away + 2.5 * std) / GOAL_RADIUS, (off + 2.5 * turn) / GOAL_HEADING_TOLERANCE)
    if abs(miss - 1.0) > 1e-6:
        assert (Parking.STOP in said) == (miss < 1.0)


def test_a_point_has_no_heading():
    assert parked(ParkingRule(CAR, GOAL[:2]), at(heading=-2.0, std=0.0, turn=1.0), 2)[-1] is Parking.STOP


def test_a_belief_wider_than_the_region_stops_by_its_mean_in_the_end():
    patience = ParkingConfig().patience
    said = parked(ParkingRule(CAR, GOAL), at(std=0.2), patience + 4)
    assert set(said[:patience]) == {Parking.DRIVE} and Parking.TRUST in said and Parking.STOP not in said
    assert Parking.TRUST not in parked(ParkingRule(CAR, GOAL), at(x=1.2, std=0.2), 3 * patience)


@pytest.mark.parametrize("heading", [3.1, -3.1])
def test_headings_are_angles(heading):
    rule = ParkingRule(CAR, np.array([1.0, 2.0, np.pi]))
    assert parked(rule, at(heading=heading), 2)[-1] is Parking.STOP
