"""Test the table of responses to failures, the manoeuvres, and how a robot notices that it does not get on."""

import math

import numpy as np
import pytest

from tests.agents.test_agents import context
from vssm_gym.agents.shared.manoeuvres import ALIGNED, Drive, Turn, around, retraced
from vssm_gym.agents.shared.progress import Progress
from vssm_gym.agents.shared.recovery import (
    IN_KNOWN_MAP,
    IN_OWN_MAP,
    PROGRESS,
    WITHOUT,
    WITHOUT_IMAGES,
    Failure,
    Recovery,
    Response,
)
from vssm_gym.envs.robots import HolonomicRobot, execute
from vssm_gym.envs.robots.holonomic import NOISE_LEVELS

HERE = np.array([1.0, 2.0, 0.5])


TABLES = {"known": IN_KNOWN_MAP, "own": IN_OWN_MAP, "without images": WITHOUT_IMAGES, "without": WITHOUT}


@pytest.mark.parametrize("table", TABLES)
def test_every_failure_has_a_row(table):
    assert set(TABLES[table]) == set(Failure)


@pytest.mark.parametrize("failure", Failure)
@pytest.mark.parametrize("table", TABLES)
def test_responses_come_in_order_and_end(table, failure):
    row = TABLES[table][failure]
    recovery = Recovery(TABLES[table])
    found = []
    while (response := recovery.response(failure, HERE)) is not None:
        found.append(response)
    assert tuple(found) == row
    assert recovery.response(failure, HERE) is None


def test_a_row_begins_anew_after_progress_and_when_overcome():
    table = IN_OWN_MAP
    recovery, failure = Recovery(table), Failure.BLOCKED
    first = recovery.response(failure, HERE)
    assert recovery.response(failure, HERE + np.array([0.5 * PROGRESS, 0, 0])) is table[failure][1]
    assert recovery.response(failure, HERE + np.array([1.1 * PROGRESS, 0, 0])) is first
    recovery.overcome(failure)
    assert recovery.response(failure, HERE + np.array([1.1 * PROGRESS, 0, 0])) is first


def test_what_a_lost_robot_was_doing_goes_on_once():
    recovery, look = Recovery(IN_OWN_MAP), Turn([1.0, 2.0], 0.2)
    recovery.manoeuvre = look
    for goes_on in (True, False):
        recovery.begin(Failure.LOST, Response.LOOK_BACK, Turn([0.0], 0.2))
        recovery.begin(Failure.LOST, Response.TURN_AROUND, Turn([0.0], 0.2))
        assert recovery.of is Failure.LOST
        recovery.found()
        assert recovery.of is None
        assert (recovery.manoeuvre is look) == goes_on


def carry_out(manoeuvre, planar: np.ndarray, noise: str, steps: int = 80) -> tuple[np.ndarray, int]:
    """Execute a manoeuvre with noise until it is done; return the last pose and the number of steps."""
    rng = np.random.default_rng(0)
    for k in range(steps):
        command = manoeuvre.command(planar)
        if command is None:
            return planar, k
        planar = execute(planar, command, NOISE_LEVELS[noise], rng)
    raise AssertionError("the manoeuvre does not end")


@pytest.mark.parametrize("noise", ["none", "low", "high"])
def test_a_full_turn_sees_every_direction_and_comes_back(noise):
    planar, rng, seen = HERE, np.random.default_rng(1), []
    turn = around(float(planar[2]), HolonomicRobot().max_turn)
    while (command := turn.command(planar)) is not None:
        assert command[1] == command[2] == 0.0
        seen.append(planar[2])
        planar = execute(planar, command, NOISE_LEVELS[noise], rng)
        assert len(seen) < 120
    assert abs(math.remainder(planar[2] - HERE[2], math.tau)) < ALIGNED
    # A camera with a field of view of 90 degrees has seen all around: no gap of more than that between headings.
    angles = np.sort(np.mod(seen, math.tau))
    assert np.diff([*angles, angles[0] + math.tau]).max() < 0.5 * math.pi


def test_a_turn_takes_the_shorter_way():
    assert Turn([3.0], 0.2).command(np.array([0.0, 0.0, -3.0]))[0] == pytest.approx(-0.2)
    assert Turn([0.05], 0.2).command(np.zeros(3)) is None


def test_a_path_is_retraced_to_where_the_robot_was():
    track = [np.array([0.1 * k, 0.0, 0.0]) for k in range(30)]
    drive = retraced(track, track[-1], context(None, np.zeros(3)))
    assert isinstance(drive, Drive)
    planar, _ = carry_out(drive, track[-1], "none")
    assert planar[0] == pytest.approx(2.9 - 1.5, abs=0.2)
    assert retraced([HERE], HERE, context(None, np.zeros(3))) is None


def test_a_drive_that_cannot_get_there_ends():
    drive = Drive([np.array([5.0, 0.0])], context(None, np.zeros(3)))
    held = sum(drive.command(np.zeros(3)) is not None for _ in range(100))
    assert 0 < held < 60


def test_a_held_robot_is_noticed_and_a_moving_one_is_not():
    held, moving, planar = Progress(), Progress(), np.zeros(3)
    noticed = []
    for k in range(6):
        noticed.append((held.is_held(np.zeros(3), 0.4, 0.35), moving.is_held(planar, 0.4, 0.35)))
        held.sent(0.16, np.zeros(3))
        moving.sent(0.16, planar)
        planar = planar + np.array([0.1, 0.0, 0.0])
        assert k < 3 or noticed[-1][0]
    assert not any(second for _, second in noticed)
    held.forget()
    assert not held.is_held(np.zeros(3), 0.4, 0.35)


def test_a_robot_that_turns_back_and_forth_is_noticed():
    progress = Progress()
    assert [progress.dithers(HERE, 0.1, 5) for _ in range(7)] == [False] * 5 + [True] * 2
    assert not progress.dithers(HERE + np.array([0.2, 0.0, 0.0]), 0.1, 5)
