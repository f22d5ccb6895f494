"""Test how a drive follows commands: its law, and the robot that has such a drive."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot
from vssm_gym.envs.robots.drive_response import WORN, DriveResponse
from vssm_gym.errors import InputError

ROBOT = HolonomicRobot(response=WORN)
DT, LIMITS = ROBOT.dt, ROBOT.limits
commands = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.08, 0.08), st.floats(0.0, 0.16)).map(np.array)
noises = pytest.mark.parametrize("noise", NOISE_LEVELS)


def steps(commands, noise="none", start=(0.0, 0.0, 0.0)):
    """Return the poses of a worn robot in free space, the start included."""
    poses, reached, rng = [np.array(start)], np.zeros(3), np.random.default_rng(0)
    for command in commands:
        reached, carried_out = ROBOT.respond(reached, np.array(command))
        poses.append(ROBOT.execute(poses[-1], carried_out, NOISE_LEVELS[noise], rng))
    return np.array(poses)


@given(commands, commands)
def test_a_drive_without_lag_or_loss_carries_out_what_is_commanded(reached, command):
    sound = DriveResponse()
    np.testing.assert_array_equal(sound.carried_out(sound.follow(reached, command, LIMITS, DT)), command)


@given(commands, st.floats(0.05, 2.0), st.integers(1, 20))
def test_a_lag_is_a_first_order_low_pass(command, lag, count):
    """From rest under one command, after k steps: ``1 - exp(-k dt / lag)`` of it; two half steps are one step."""
    response, reached = DriveResponse(lag=lag), np.zeros(3)
    for _ in range(count):
        reached = response.follow(reached, command, LIMITS, DT)
    np.testing.assert_allclose(reached, command * (1.0 - math.exp(-count * DT / lag)), atol=1e-12)
    halves = response.follow(response.follow(np.zeros(3), command, LIMITS, DT / 2), command, LIMITS, DT / 2)
    np.testing.assert_allclose(halves, response.follow(np.zeros(3), command, LIMITS, DT), atol=1e-12)


def test_gains_by_hand():
    np.testing.assert_allclose(
        DriveResponse(gains=(0.5, 1.0, 0.8)).carried_out(np.array([0.1, 0.02, 0.1])), [0.05, 0.02, 0.08]
    )


@noises
def test_a_robot_that_is_told_to_rest_comes_to_rest(noise):
    """Noise drives no robot whose drive stands, however long: what is left of a motion ends by friction."""
    poses = steps([(0.2, 0.05, 0.16)] * 10 + [(0.0, 0.0, 0.0)] * 200, noise)
    moving = np.flatnonzero(np.any(np.diff(poses, axis=0) != 0.0, axis=1))
    assert 12 < moving[-1] < 20


@noises
def test_a_turn_on_the_spot_ends_the_drive_before_it(noise):
    poses = steps([(0.0, 0.0, 0.16)] * 5 + [(0.2, 0.0, 0.0)] * 60, noise)
    np.testing.assert_array_equal(poses[-1, :2], poses[20, :2])


@noises
def test_the_pull_is_the_same_at_every_noise(noise):
    """Driven straight ahead, it turns by -0.1 rad for every metre that it has driven."""
    poses = steps([(0.0, 0.0, 0.16)] * 200, noise)
    metres = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum()
    assert np.unwrap(poses[:, 2])[-1] == pytest.approx(WORN.pull * metres, rel=1e-9)


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"lag": -0.1}, "lag"),
        ({"lag": math.inf}, "lag"),
        ({"gains": (1.0, 0.0, 1.0)}, "gains"),
        ({"gains": (1.0, 1.0)}, "gains"),
        ({"pull": math.nan}, "pull"),
    ],
)
def test_impossible_responses_are_refused(wrong, field):
    with pytest.raises(InputError, match=f"DriveResponse: {field}"):
        DriveResponse(**wrong)


def driven(robot, controls):
    """Return true poses and images after each command from one start without noise."""
    env = gym.make("vssm_gym/PointNav-v0", scene="fern", robot=robot, noise="none", camera={"width": 16, "height": 12})
    env.reset(seed=3)
    poses = [env.unwrapped.planar]
    for control in controls:
        *_, info = env.step(np.array([*control, 0.0], np.float32))
        poses.append(env.unwrapped.planar)
    env.reset(seed=3)
    np.testing.assert_array_equal(env.unwrapped.planar, poses[0])
    again = env.step(np.array([*controls[0], 0.0], np.float32))[-1]
    np.testing.assert_allclose(env.unwrapped.planar, poses[1], atol=1e-9)  # a reset has stopped the drive
    assert not info["collision"] and not again["collision"]
    env.close()
    return np.array(poses)


def test_the_worn_robot_starts_late_falls_short_and_coasts():
    """Driven slowly and then told to rest, it makes less than 85 % of the commanded length, and pulls to the right."""
    controls = [(0.0, 0.0, 0.03)] * 4 + [(0.0, 0.0, 0.0)] * 12
    worn, sound = driven("worn", controls), driven("holonomic", controls)
    length = lambda poses: np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    first = WORN.gains[2] * 0.03 * (1.0 - math.exp(-DT / WORN.lag))
    assert length(worn)[0] == pytest.approx(first, abs=1e-4)
    assert length(worn)[4] > 0.01 and length(sound)[4] < 1e-6
    metres = length(worn).sum()
    assert 0.85 * 0.12 - 0.013 < metres < 0.85 * 0.12  # friction takes the last centimetre
    assert worn[-1, 2] - worn[0, 2] == pytest.approx(WORN.pull * metres, abs=1e-4)
    assert abs(sound[-1, 2] - sound[0, 2]) < 1e-6


def test_a_drive_has_no_compass():
    with pytest.raises(InputError, match="direction_frame"):
        gym.make("vssm_gym/PointNav-v0", scene="fern", robot="worn", direction_frame="world")
