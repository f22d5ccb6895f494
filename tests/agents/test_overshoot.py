"""Test the evidence for a wrong scale of the depth: the estimates go beyond the commands, step after step."""

import math
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.agents.shared.overshoot import Overshoot, OvershootConfig
from vssm_gym.model.transition import Bicycle, MotionNoise, Planar
from vssm_gym.model.transition.base import Transition

LOW = Planar(MotionNoise(math.radians(3.0), 0.02))
COMMAND = np.array([0.05, 0.1, 0.16])
DT = 0.2


def first_noticed(transition: Transition, poses: list[jax.Array], command: np.ndarray) -> int | None:
    """Return the number of steps along ``poses`` until they are noticed to go too far."""
    watch = Overshoot(transition, DT, OvershootConfig())
    for k in range(1, len(poses)):
        if watch.update(poses[k - 1], command, poses[k]):
            return k
    return None


def driven(transition: Transition, command: np.ndarray, scale: float, steps: int, start: jax.Array) -> list[jax.Array]:
    """Return the poses of a robot whose every motion is ``scale`` times the commanded one."""
    poses = [start]
    for _ in range(steps):
        motion = transition.manifold.error(poses[-1], transition.mean(poses[-1], jnp.asarray(command), DT))
        poses.append(transition.manifold.perturb(poses[-1], scale * motion))
    return poses


@pytest.mark.parametrize(("scale", "noticed"), [(1.2, True), (1.0, False), (0.5, False), (0.0, False)])
def test_only_motion_beyond_the_commands_is_noticed(scale, noticed):
    assert (first_noticed(LOW, driven(LOW, COMMAND, scale, 24, jnp.zeros(3)), COMMAND) is not None) == noticed


def test_a_car_is_judged_by_its_own_noise():
    car = Bicycle()
    command = np.array([1.0, 0.1])
    assert first_noticed(car, driven(car, command, 1.3, 60, jnp.zeros(3)), command) is not None
    assert first_noticed(car, driven(car, command, 1.0, 60, jnp.zeros(3)), command) is None


@pytest.mark.slow
def test_noise_is_not_noticed():
    """None of 20 drives of 100 steps with the noise of the transition goes too far."""
    keys = jax.random.split(jax.random.key(0), (100, 20))
    poses = [jnp.zeros((20, 3))]
    for some in keys:
        sampled = jax.vmap(lambda key, pose: LOW.sample(key, pose, jnp.asarray(COMMAND), DT))(some, poses[-1])
        poses.append(sampled)
    for drive in range(20):
        assert first_noticed(LOW, [pose[drive] for pose in poses], COMMAND) is None


def test_one_shove_is_no_scale_and_turns_in_place_prove_nothing():
    shoved = driven(LOW, COMMAND, 1.0, 10, jnp.zeros(3))
    shoved += driven(LOW, COMMAND, 1.0, 10, shoved[-1] + jnp.array([0.5, 0.3, 0.0]))
    assert first_noticed(LOW, shoved, COMMAND) is None
    turn = np.array([0.2, 0.0, 0.0])
    assert first_noticed(LOW, driven(LOW, turn, 1.3, 40, jnp.zeros(3)), turn) is None


def test_it_is_remembered_while_the_robot_stands_and_forgotten_on_request():
    watch, poses = Overshoot(LOW, DT, OvershootConfig()), driven(LOW, COMMAND, 1.2, 24, jnp.zeros(3))
    noticed = [watch.update(a, COMMAND, b) for a, b in pairwise(poses)]
    assert noticed[-1]
    assert watch.update(poses[-1], np.zeros(3), poses[-1])
    watch.reset()
    assert not watch.update(poses[-1], np.zeros(3), poses[-1])
