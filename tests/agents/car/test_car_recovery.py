"""Test the table of a car's responses to failures, and the motions that need no plan."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.agents.shared.car.recovery import (
    BACK_SPEED,
    LASTING,
    RESPONSES,
    Failure,
    Recovery,
    Response,
    Trail,
    creeping,
    leads_into,
)
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena, collides

CAR = Car()


def driven(pose: np.ndarray, command: np.ndarray) -> np.ndarray:
    s = float(command[0]) * CAR.dt
    return poses_after(pose[2], np.array(s), turn_of(s, float(command[1]), CAR.wheelbase), pose[0], pose[1])


@pytest.mark.parametrize("failure", Failure)
def test_each_failure_is_answered_in_order_and_counted(failure):
    recovery = Recovery()
    wanted = [response for response, steps in RESPONSES[failure] for _ in range(steps)]
    assert [recovery.step(failure) for _ in wanted] == wanted
    stages = [response for response, _ in RESPONSES[failure]]
    assert recovery.counts == {response.value: stages.count(response) for response in stages}
    assert (wanted[-1] is Response.GIVE_UP) == (failure in LASTING)  # what lasts ends the task, the rest goes on


@pytest.mark.parametrize("failure", Failure)
def test_a_lasting_failure_ends_with_its_cause_and_the_others_are_carried_out(failure):
    recovery = Recovery()
    first = recovery.step(failure)
    assert first is RESPONSES[failure][0][0]
    steps = sum(steps for _, steps in RESPONSES[failure])
    after = [recovery.step(None) for _ in range(steps)]
    assert after[-1] is Response.DRIVE and recovery.failure is None
    if failure in LASTING:
        assert set(after) == {Response.DRIVE}
    else:
        assert after.count(Response.DRIVE) == 1


def test_a_car_that_is_lost_while_it_backs_up_brakes_first():
    recovery = Recovery()
    assert [recovery.step(Failure.STUCK) for _ in range(2)] == [Response.BRAKE, Response.BACK_UP]
    assert recovery.step(Failure.LOST) is Response.BRAKE and recovery.failure is Failure.LOST


commands = st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.5, 0.5)).map(np.array), min_size=1, max_size=25)


@given(commands)
def test_a_trail_leads_back_to_where_it_began(path):
    trail, pose = Trail(CAR), np.zeros(3)
    for command in path:
        trail.drove(command)
        pose = driven(pose, command)
    steps = 0
    while (command := trail.back()) is not None:
        assert abs(command[0]) <= BACK_SPEED + 1e-9
        pose, steps = driven(pose, command), steps + 1
    np.testing.assert_allclose(pose, 0.0, atol=1e-6)
    assert steps >= sum(abs(speed) for speed, _ in path) / BACK_SPEED - 1e-6


def arena(*ahead: int) -> Arena:
    occupied = np.zeros((60, 60), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    for i in ahead:
        occupied[i, 20:41] = True
    return Arena.from_occupied(occupied, np.array([-1.5, -1.5]), 0.05)


def test_it_creeps_ahead_then_back_then_stands():
    assert creeping(arena(), np.zeros(3), CAR)[0] > 0.0
    back = creeping(arena(38), np.zeros(3), CAR)
    assert back[0] < 0.0
    assert not creeping(arena(38, 27), np.zeros(3), CAR).any()


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-3.1, 3.1))
def test_where_it_creeps_nothing_is_in_its_way(x, y, heading):
    world, pose = arena(40), np.array([x, y, heading])
    if not collides(world, pose, CAR):
        for _ in range(3):
            pose = driven(pose, creeping(world, pose, CAR))
            assert not collides(world, pose, CAR, -0.01)


@pytest.mark.parametrize(("column", "speed", "led"), [(20, -0.25, True), (20, 0.25, False), (10, -0.25, False)])
def test_it_does_not_back_up_into_what_it_has_mapped_meanwhile(column, speed, led):
    """Behind the car, 8 cm from its bumper; on the other side; out of reach. From inside an obstacle it may leave."""
    world = arena(column)
    ahead = lambda x: leads_into(
        world.occupied, world.origin, world.resolution, np.array([x, 0.0, 0.0]), np.array([speed, 0.0]), CAR
    )
    assert ahead(-0.33) == led
    assert column != 20 or not ahead(-0.45)
