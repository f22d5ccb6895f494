"""Test that faults reach the images alone, begin and end when they should, and carry robots to free places."""

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.faults.faulty_env import CARRIED, FaultyEnv

CAMERA = CameraConfig(width=16, height=12)
DRIVE = np.array([0.1, 0.0, 0.1, 0.0], np.float32)


@pytest.fixture(scope="module")
def env() -> gym.Env:
    return gym.make("vssm_gym/PointNav-v0", scene=two_rooms(), noise="none", camera=CAMERA, disable_env_checker=True)


def images(env: gym.Env, steps: int = 9) -> list[dict[str, np.ndarray]]:
    """Return the observations of a reset and ``steps`` steps."""
    observations = [env.reset(seed=1)[0]]
    return observations + [env.step(DRIVE)[0] for _ in range(steps)]


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return np.array_equal(a["rgb"], b["rgb"]) and np.array_equal(a["depth"], b["depth"])


@pytest.mark.parametrize(("steps", "faulty"), [(3, {4, 5, 6}), (None, {4, 5, 6, 7, 8, 9})])
def test_images_freeze_for_so_many_steps(steps, faulty, env):
    intact, damaged = images(env), images(FaultyEnv(env, "frozen", 4, steps))
    for k, (before, after) in enumerate(zip(intact, damaged, strict=True)):
        assert same(after, intact[3]) if k in faulty else same(after, before)
        assert np.array_equal(after["goal"], before["goal"])


@pytest.mark.parametrize("fault", CARRIED)
def test_a_robot_is_carried_to_a_free_place(fault, env):
    """Once, by the distance of the fault, and the images are those of its new place."""
    intact, faulty = images(env), FaultyEnv(env, fault, 4, seed=3)
    carried, world = images(faulty), env.unwrapped
    path = np.array(faulty.true)
    steps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    least, most, _ = CARRIED[fault]
    assert np.flatnonzero(steps > 0.11).tolist() == [3]
    assert least - 0.11 <= steps[3] <= most + 0.11
    assert world.sampler.space.contains(path[4:, :2]).all()
    assert [same(a, b) for a, b in zip(intact, carried, strict=True)] == [True] * 4 + [False] * 6
    assert len(path) == len(carried)


def test_a_car_is_carried_off_too():
    env = gym.make("vssm_gym/CarNav-v0", scene=two_rooms(), images=True, camera=CAMERA, disable_env_checker=True)
    faulty = FaultyEnv(env, "shove", 2, seed=0)
    faulty.reset(seed=0)
    for _ in range(3):
        faulty.step(np.zeros(2, np.float32))
    moved = np.linalg.norm(np.diff(np.array(faulty.true)[:, :2], axis=0), axis=1)
    assert np.flatnonzero(moved > 0.1).tolist() == [1]
    env.close()


def test_an_unknown_fault_is_refused(env):
    with pytest.raises(InputError, match=r"one of .*frozen.*kidnap"):
        FaultyEnv(env, "rain", 3)
