"""Test CarNav-v1, which ends at the agent's stop: success needs a car that stands in the target's region."""

import gymnasium as gym
import numpy as np
import pytest

from tests.envs.test_carnav import OPEN, make
from vssm_gym.envs.carnav import CARNAV_REWARD, STANDING_SPEED
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.errors import InputError

START = (0.6, 1.5, 0.0)
CONTROLS = ("speed", "acceleration")


@pytest.fixture(params=["mujoco", "bullet"])
def physics(request):
    if request.param == "bullet":
        pytest.importorskip("pybullet", reason="the bullet extra is not installed")
    return request.param


def begun(goal, **keywords):
    env = make(end_on="stop", **keywords)
    env.reset(seed=0, options={"task": env.sampler.task(START, goal)})
    return env


def drive(env, speed, metres):
    """Drive straight until so many metres are behind the car; nothing may end the episode."""
    while env.path_length < metres:
        _, _, terminated, _, info = env.step([speed, 0.0, 0.0])
        assert not terminated and not info["success"]


def test_its_id_has_one_more_action_and_differs_in_nothing_else():
    old, new = (gym.make(f"vssm_gym/CarNav-v{n}", images=False, disable_env_checker=True) for n in (0, 1))
    assert old.action_space.shape == (2,) and new.action_space.shape == (3,)
    assert new.action_space.low[2] == 0.0 and new.action_space.high[2] == 1.0
    assert old.observation_space == new.observation_space
    specs = [ENVIRONMENTS[f"vssm_gym/CarNav-v{n}"] for n in (0, 1)]
    assert specs[0].protocol == specs[1].protocol and specs[0].max_episode_steps == specs[1].max_episode_steps


def test_the_same_commands_move_it_as_in_the_first_version():
    one, other = begun((2.0, 1.5, 0.0), noise="high"), make(noise="high")
    other.reset(seed=0, options={"task": other.sampler.task(START, (2.0, 1.5, 0.0))})
    for steering in (0.3, -0.2, 0.0, 0.4):
        one.step([0.5, steering, 0.4])  # no stop
        other.step([0.5, steering])
        np.testing.assert_array_equal(one.planar, other.planar)


def test_an_arrival_without_a_stop_ends_nothing():
    env = begun((1.2, 1.5, 0.0))
    drive(env, 0.3, 1.0)


def test_it_succeeds_where_it_stands_and_stops(physics):
    env = begun((1.2, 1.5, 0.0), physics=physics, reward="sparse")
    drive(env, 0.3, 0.55)
    for _ in range(3):
        env.step([0.0, 0.0, 0.0])
    _, reward, terminated, truncated, info = env.step([0.0, 0.0, 1.0])
    assert terminated and not truncated and info["success"] and info["reason"] == "stopped at the target"
    assert reward == CARNAV_REWARD.success and info["spl"] > 0.9
    with pytest.raises(gym.error.ResetNeeded):
        env.step([0.0, 0.0, 0.0])


@pytest.mark.parametrize("goal", [(2.2, 1.5, 0.0), (1.2, 1.5, 0.4)])
def test_a_stop_elsewhere_or_askew_fails(goal):
    env = begun(goal, scene=OPEN, reward="sparse")
    drive(env, 0.3, 0.55)
    for _ in range(3):
        env.step([0.0, 0.0, 0.0])
    _, reward, terminated, _, info = env.step([0.0, 0.0, 1.0])
    assert terminated and not info["success"] and info["reason"] == "stopped elsewhere" and reward == 0.0


@pytest.mark.parametrize("control", CONTROLS)
def test_a_car_that_rolls_at_its_stop_fails(control, physics):
    """From full speed the step of the stop is too short to brake: to pass the target is no arrival."""
    env = begun((1.6, 1.5, 0.0), physics=physics, control=control, noise="mid")
    if control == "speed":
        drive(env, 0.6, 0.9)
    else:
        while env.path_length < 0.9:
            env.step([2.0, 0.0, 0.0])
    before = env.body.speed()
    _, _, terminated, _, info = env.step([0.6, 0.0, 1.0])
    assert terminated and not info["success"] and info["reason"] == "stopped while it rolled"
    assert STANDING_SPEED < env.body.speed() < before  # it braked
    assert info["control"][0] == (0.0 if control == "speed" else pytest.approx(-2.0))


def test_an_acceleration_that_stops_ends_at_rest():
    """A commanded speed below 0.2 m/s falls to zero within the step, and no further."""
    env = begun((0.8, 1.5, 0.0), control="acceleration")
    env.step([1.0, 0.0, 0.0])
    _, _, terminated, _, info = env.step([1.0, 0.0, 1.0])
    assert terminated and info["control"][0] == pytest.approx(-1.0)


def test_a_chain_continues_from_the_stop():
    env = begun((1.2, 1.5, 0.0), chain=True)
    drive(env, 0.4, 0.3)
    env.step([0.4, 0.0, 1.0])
    before = env.planar
    _, info = env.reset()
    np.testing.assert_array_equal(info["start_pose"], before)
    assert not env.step([0.2, 0.0, 0.0])[2]


def test_normalized_actions_stop_above_zero():
    env = begun((1.2, 1.5, 0.0), actions="normalized")
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    assert not env.step([0.0, 0.0, -0.1])[2]
    assert env.step([0.0, 0.0, 0.1])[2]


def test_other_ends_and_actions_are_refused():
    with pytest.raises(InputError, match="CarNav: end_on: expected one of 'stop', 'reach'"):
        make(end_on="never")
    env = begun((1.2, 1.5, 0.0))
    with pytest.raises(InputError, match="stop"):
        env.step([0.1, 0.0])
