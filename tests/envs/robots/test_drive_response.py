"""Test how a drive follows commands: its law, and the robot that has such a drive."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.robots.drive_response import WORN, DriveResponse
from vssm_gym.errors import InputError

DT = HolonomicRobot().dt
AHEAD = np.array([0.05, 0.02, 0.1])
commands = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.08, 0.08), st.floats(0.0, 0.16)).map(np.array)


@given(commands, commands)
def test_a_drive_without_lag_or_loss_carries_out_what_is_commanded(reached, command):
    sound = DriveResponse()
    np.testing.assert_array_equal(sound.carried_out(sound.follow(reached, command, DT)), command)


@given(commands, st.floats(0.05, 2.0), st.integers(1, 20))
def test_a_lag_is_a_first_order_low_pass(command, lag, steps):
    """From rest under one command, after k steps: ``1 - exp(-k dt / lag)`` of it; two half steps are one step."""
    response, reached = DriveResponse(lag=lag), np.zeros(3)
    for _ in range(steps):
        reached = response.follow(reached, command, DT)
    np.testing.assert_allclose(reached, command * (1.0 - math.exp(-steps * DT / lag)), atol=1e-12)
    halves = response.follow(response.follow(np.zeros(3), command, DT / 2), command, DT / 2)
    np.testing.assert_allclose(halves, response.follow(np.zeros(3), command, DT), atol=1e-12)


def test_gains_and_pull_by_hand():
    np.testing.assert_allclose(DriveResponse(gains=(0.5, 1.0, 0.8), pull=-0.1).carried_out(AHEAD), [0.017, 0.02, 0.08])


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
    """Driven slowly and then told to rest, it makes 85 % of the commanded length, and pulls to the right."""
    controls = [(0.0, 0.0, 0.03)] * 4 + [(0.0, 0.0, 0.0)] * 12
    worn, sound = driven("worn", controls), driven("holonomic", controls)
    length = lambda poses: np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    first = WORN.gains[2] * 0.03 * (1.0 - math.exp(-DT / WORN.lag))
    assert length(worn)[0] == pytest.approx(first, abs=1e-4)
    assert length(worn)[4] > 0.01 and length(sound)[4] < 1e-6
    assert length(worn).sum() == pytest.approx(0.85 * 0.12, abs=2e-3)
    assert worn[-1, 2] - worn[0, 2] == pytest.approx(WORN.pull * 0.85 * 0.12, abs=1e-3)
    assert abs(sound[-1, 2] - sound[0, 2]) < 1e-6


def test_a_drive_has_no_compass():
    with pytest.raises(InputError, match="direction_frame"):
        gym.make("vssm_gym/PointNav-v0", scene="fern", robot="worn", direction_frame="world")
