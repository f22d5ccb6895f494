"""Test the table of a car's responses to failures, and the motions that need no plan."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.agents.shared.car.recovery import (
    BACK_SPEED,
    LASTING,
    LEAST,
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


@pytest.mark.parametrize(
    "pattern", [(Failure.LOST, Failure.LOST, Failure.UNCONFIRMED), (Failure.REPEATED, Failure.LOST)]
)
def test_failures_that_alternate_do_not_begin_anew(pattern):
    """Each goes on where it was, and the car gives up when one of them has come to its end."""
    recovery, longest = Recovery(), sum(sum(steps for _, steps in RESPONSES[failure]) for failure in set(pattern))
    found = [recovery.step(pattern[k % len(pattern)]) for k in range(longest)]
    assert Response.BACK_UP in found and Response.GIVE_UP in found
    recovery.step(None)
    assert recovery.step(pattern[0]) is RESPONSES[pattern[0]][0][0]


@pytest.mark.parametrize("between", [Failure.STUCK, Failure.NO_PATH, None])
def test_a_car_that_knew_its_pose_meanwhile_is_lost_anew(between):
    recovery = Recovery()
    for _ in range(10):
        recovery.step(Failure.LOST)
    recovery.step(between)
    assert recovery.step(Failure.LOST) is RESPONSES[Failure.LOST][0][0]


commands = st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.5, 0.5)).map(np.array), min_size=1, max_size=25)


@given(commands)
def test_a_trail_leads_back_to_where_it_began(path):
    trail, pose = Trail(CAR, np.zeros(3)), np.zeros(3)
    for command in path:
        pose = driven(pose, command)
        trail.drove(pose)
    while (command := trail.back()) is not None:
        assert abs(command[0]) <= BACK_SPEED + 1e-9
        trail.undo()
        pose = driven(pose, command)
    # up to 1 cm at its end is not recorded, in which it may have turned by that over its turning radius
    assert np.hypot(*pose[:2]) < LEAST + 0.002 * len(path) and abs(pose[2]) < 0.04


def test_a_car_that_is_held_has_driven_nothing():
    """The estimate jitters by a millimetre: eight steps of commands that did not move it are no path."""
    trail = Trail(CAR, np.zeros(3))
    for k in range(8):
        trail.drove(np.array([0.001 * (-1) ** k, 0.001, 0.001]))
    assert trail.back() is None


def test_an_estimate_that_jumps_was_not_driven():
    trail = Trail(CAR, np.zeros(3))
    trail.drove(np.array([0.5, 0.3, 0.0]))
    assert trail.back() is None
    trail.drove(np.array([0.52, 0.3, 0.0]))
    np.testing.assert_allclose(trail.back(), [-0.2, 0.0])


def test_a_piece_is_kept_until_it_is_driven():
    """To ask for the way back discards nothing: a car that brakes before an obstacle is still at its end."""
    trail = Trail(CAR, np.zeros(3))
    trail.drove(np.array([0.02, 0.0, 0.0]))
    assert all(np.allclose(trail.back(), [-0.2, 0.0]) for _ in range(3))
    trail.undo()
    assert trail.back() is None


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
