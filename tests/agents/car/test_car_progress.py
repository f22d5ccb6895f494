"""Test when a car counts as held, and when it counts as getting on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.agents.shared.car.progress import Progress, Stuck, StuckConfig

CONFIG = StuckConfig()
SPEED = 0.3  # m/s, of the commands


def answers(commands: np.ndarray, places: np.ndarray) -> list[float | None]:
    """Return the answer of each step to lengths (m) and positions along a line, m."""
    stuck = Stuck()
    return [stuck.step(length, np.array([x, 0.0])) for length, x in zip(commands, places, strict=True)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_car_that_stands_although_commanded_is_held_and_says_which_end(sign):
    lengths = sign * np.full(CONFIG.steps, 0.1 * SPEED)
    found = answers(lengths, np.zeros(CONFIG.steps))
    assert found[:-1] == [None] * (CONFIG.steps - 1)
    assert found[-1] is not None and np.sign(found[-1]) == sign


@pytest.mark.parametrize("speed", [0.15, -0.15])
def test_a_car_that_is_held_on_its_way_stops_pushing_after_three_steps(speed):
    """It creeps, and something that it has not seen holds it from one step to the next."""
    places = 0.1 * speed * np.minimum(np.arange(20), 10)
    found = answers(np.full(20, 0.1 * speed), places)
    first = next(k for k, one in enumerate(found) if one is not None)
    assert first == 10 + CONFIG.recent


@given(st.lists(st.floats(-0.06, 0.06), min_size=1, max_size=40))
def test_a_car_that_moves_as_commanded_is_not_held(lengths):
    assert answers(np.array(lengths), np.cumsum(lengths)) == [None] * len(lengths)


def test_a_car_that_rolls_on_after_a_change_of_gear_is_not_held():
    """Its speed follows the command by a lag of 0.2 s: for a while it is where it was as it was commanded back."""
    commanded = np.concatenate([np.full(15, 0.6), np.full(20, -0.2)])
    speed, driven = 0.0, []
    for wanted in commanded:
        speed += (wanted - speed) * (1.0 - np.exp(-0.1 / 0.2))
        driven.append(0.1 * speed)
    places = np.cumsum(driven)
    assert answers(0.1 * commanded, places) == [None] * len(commanded)
    ends = np.abs(places[CONFIG.steps - 1 :] - places[: -CONFIG.steps + 1])[14:]
    assert ends.min() < CONFIG.share * 0.02 * (CONFIG.steps - 1)  # by these alone it would be


def test_progress_is_what_is_left_and_not_the_distance():
    progress = Progress(0.3)
    for k in range(10):
        progress.see(1, 20.0 - 0.1 * k)  # slow, but it gets on
        progress.drove()
        assert progress.steps <= 5
    for k in range(10):
        progress.see(1, 18.9 + 0.1 * (k % 2))
        progress.drove()
    assert progress.steps >= 10


def test_a_new_cost_to_go_is_no_progress_of_its_own():
    progress = Progress(0.3)
    for k in range(20):
        progress.see(k // 5, 50.0 - 10.0 * (k // 5))
        progress.drove()
    assert progress.steps == 20
    progress.see(3, 19.0)
    assert progress.steps == 0


def test_to_get_back_what_was_lost_is_no_progress():
    progress = Progress(0.3)
    for left in (20.0, 20.0, 24.0):
        progress.see(1, left)
        progress.drove()
    progress.restart()
    for left in (24.0, 22.0, 20.0):
        progress.see(1, left)
        progress.drove()
    assert progress.steps == 3
