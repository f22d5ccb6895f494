"""Test reference flights: closed, smooth, of the given speed, feasible for rotors along body z, clear of obstacles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.helpers.flight_hall import hall
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.tasks.reference_flights import (
    CLEARANCE,
    CURVES,
    FLIGHT_HEIGHT,
    FLIGHT_LIFT,
    HOVER,
    Placement,
    ReferenceFlight,
    place,
)
from vssm_gym.errors import InputError
from vssm_gym.geometry.gravity import GRAVITY

PLACE = Placement((1.0, -2.0), 4.0, 0.7)
names = st.sampled_from(sorted(CURVES))
speeds = st.floats(0.5, 6.0)
yaws = st.sampled_from(["forward", "constant"])
flights = st.builds(ReferenceFlight, names, speeds, st.just(PLACE), yaws, st.integers(1, 2), st.floats(0.0, 0.5))


@given(flights)
@settings(deadline=None, max_examples=30)
def test_it_is_closed_and_hovers_at_both_ends(flight):
    motion = flight.at(np.array([0.0, HOVER, flight.duration - HOVER, flight.duration]))
    assert np.ptp(motion.position, axis=0).max() < 1e-9
    assert np.abs(motion.velocity).max() < 1e-9
    assert np.abs(motion.acceleration).max() < 1e-9
    assert np.ptp(motion.R_world_body, axis=0).max() < 1e-6


@given(flights)
@settings(deadline=None, max_examples=30)
def test_velocity_and_acceleration_are_the_derivatives(flight):
    """Central differences, at random moments and where the law of time changes."""
    joints = HOVER + np.array([0.0, flight.ramp, flight.duration - 2.0 * HOVER - flight.ramp])
    t = np.concatenate([np.random.default_rng(0).uniform(0.0, flight.duration, 50), joints])
    h = 1e-4
    before, now, after = flight.at(t - h), flight.at(t), flight.at(t + h)
    np.testing.assert_allclose((after.position - before.position) / (2 * h), now.velocity, atol=1e-5)
    np.testing.assert_allclose((after.velocity - before.velocity) / (2 * h), now.acceleration, atol=1e-4)


@given(flights)
@settings(deadline=None, max_examples=30)
def test_the_peak_speed_is_the_given_one(flight):
    speed = np.linalg.norm(flight.at(np.linspace(0.0, flight.duration, 20000)).velocity, axis=1)
    assert speed.max() <= flight.speed * (1.0 + 1e-6)
    if 2.0 * np.pi * flight.laps / flight.rate > 1.5 * flight.ramp:  # else it is never at full speed
        assert speed.max() >= 0.9 * flight.speed


@pytest.mark.parametrize("name", CURVES)
def test_no_curve_stops_or_has_a_corner(name):
    tangent = CURVES[name].derivative(np.linspace(0.0, 2.0 * np.pi, 4096), 1)[:, :2]
    assert np.linalg.norm(tangent, axis=1).min() > 0.2


@given(flights)
@settings(deadline=None, max_examples=30)
def test_the_attitude_follows_from_thrust_and_heading(flight):
    t = np.linspace(0.0, flight.duration, 200)
    motion = flight.at(t)
    R = motion.R_world_body
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-9)
    force = np.einsum("nji,nj->ni", R, motion.acceleration - GRAVITY + flight.drag * motion.velocity)
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-9)  # nothing is left to push sideways
    assert (force[:, 2] > 0.0).all()
    nose = R[:, :2, 0] / np.linalg.norm(R[:, :2, 0], axis=1, keepdims=True)
    if flight.yaw == "constant":
        np.testing.assert_allclose(nose, np.tile([np.cos(0.7), np.sin(0.7)], (200, 1)), atol=1e-9)
    else:
        speed = np.linalg.norm(motion.velocity[:, :2], axis=1)
        along = np.einsum("ni,ni->n", nose, motion.velocity[:, :2])
        np.testing.assert_allclose(along, speed, atol=1e-9 + 1e-6 * flight.speed)


@given(flights)
@settings(deadline=None, max_examples=10)
def test_body_rates_integrate_to_the_attitude(flight):
    h = 0.002
    t = np.arange(HOVER, HOVER + 4.0, h)
    R = flight.at(t[:1]).R_world_body[0]
    for rate in flight.body_rates(t + 0.5 * h):
        R = R @ Rotation.from_rotvec(h * rate).as_matrix()
    end = flight.at(t[-1:] + h).R_world_body[0]
    assert np.linalg.norm(Rotation.from_matrix(R.T @ end).as_rotvec()) < 1e-3


@pytest.mark.parametrize("name", CURVES)
def test_a_placement_keeps_its_distance(name):
    scene = hall()
    flight = ReferenceFlight(name, 2.0, place(scene, name))
    path = flight.at(np.linspace(0.0, flight.duration, 2000)).position
    space = FreeSpace.from_apartment(scene, 0.0, FLIGHT_HEIGHT + FLIGHT_LIFT + CLEARANCE)
    assert space.distance_to_obstacle(path[:, :2]).min() > CLEARANCE - 0.02  # checked between the samples of the fit
    assert path[:, 2].min() > CLEARANCE
    assert path[:, 2].max() < scene.ceiling_height - CLEARANCE
    assert flight.place.scale > 2.0


def test_an_infeasible_flight_is_refused():
    with pytest.raises(InputError, match="space for the flight"):
        place(hall(width=2.5), "star")
    with pytest.raises(InputError, match="ceiling_height"):
        place(hall(ceiling=2.4), "star")
    with pytest.raises(InputError, match="name"):
        place(hall(), "loop")
    for field, value in (("name", "loop"), ("yaw", "up"), ("speed", 0.0), ("speed", np.nan), ("laps", 0)):
        with pytest.raises(InputError, match=field):
            ReferenceFlight(**{"name": "star", "speed": 1.0, "place": PLACE, field: value})
