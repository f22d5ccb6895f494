"""Test robots that are imagined to move by a learned transition."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.dynamics.transitions import random_transition
from tests.helpers.imagined_room import make_vec, task
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.learned import CORRECTION_PER_STD
from vssm_gym.model.transition.learned_file import calibrated, load_transition, save_transition
from vssm_gym.model.transition.with_rest import RestState

START = (1.5, 1.0, 0.3)
ROBOTS, STEPS = 1024, 6
COMMANDS = {"holonomic": (0.1, 0.05, 0.1), "car": (0.4, 0.2)}
EXACT = {"pose_std": (0.0, 0.0, 0.0)}


def saved(folder, kind, further=0):
    """Write a transition with random weights, small errors, and a rest that is noisy and matters.

    Its step is the robot's, and twice that of the car, whose controls are speeds.
    """
    learned = random_transition(calibrated(kind), further=further, spread=0.03, seed=3)
    errors, rest = 0.02 * jnp.ones_like(learned.scales.errors), slice(-learned.size, None)
    n = len(learned.nominal.manifold.turns)
    network = eqx.tree_at(lambda net: net.offset, learned.network, learned.network.offset.at[rest].set(jnp.log(0.4)))
    unit = jnp.eye(learned.size, n)
    by_rest = network.linear.at[-learned.size :, :n].set(1.5 / CORRECTION_PER_STD * unit)
    by_rest = by_rest.at[-learned.size :, n : n + learned.size].set(0.7 * unit[:, : learned.size])  # it forgets
    network = eqx.tree_at(lambda net: net.linear, network, by_rest)
    parts = lambda t: (t.network, t.scales.errors, t.scales.step)
    learned = eqx.tree_at(parts, learned, (network, errors, jnp.asarray(0.2)))
    save_transition(folder / f"{kind}.npz", learned, kind, {})
    return folder / f"{kind}.npz"


def of_step(folder, step):
    """Write a transition of the holonomic robot that was learned for another step."""
    learned = eqx.tree_at(lambda t: t.scales.step, random_transition(calibrated("holonomic")), jnp.asarray(step))
    save_transition(folder / "step.npz", learned, "holonomic", {})
    return folder / "step.npz"


def imagined(file, kind, steps=STEPS):
    """Return the true poses of robots that start alike and get the same command, ``(steps, robots, 3)``."""
    keywords = {"robot": kind, "transition": file, "tasks": [task(START, (4.0, 1.2))], "end_on": "reach"}
    env = make_vec(ROBOTS, **keywords | EXACT)
    env.reset(seed=0)
    command = COMMANDS[kind] + (0.0,) * (kind == "holonomic")
    poses = []
    for _ in range(steps):
        *_, infos = env.step(np.tile(np.array(command, np.float32), (ROBOTS, 1)))
        assert not infos["collision"].any()
        poses.append(env.planar)
    env.close()
    return np.array(poses)


@pytest.mark.slow
@pytest.mark.parametrize("kind", COMMANDS)
def test_robots_move_as_the_transition_draws(tmp_path, kind):
    """Means and spreads of their paths are those of the transition's own, begun with the rest of a robot that stood."""
    file = saved(tmp_path, kind)
    found, transition = imagined(file, kind), load_transition(file).transition
    dt = 0.2 if kind == "holonomic" else Car().dt
    manifold = transition.nominal.manifold
    start = GaussianBelief(jnp.array(START), jnp.eye(len(manifold.turns)) * 1e-12, manifold)
    by_start, by_rest, by_path = jax.random.split(jax.random.key(1), 3)
    states = transition.extend(start).sample(by_start, 4096)
    stood = transition.sample_paths(by_rest, states, jnp.zeros((150, transition.controls)), dt)
    states = RestState(states.body, stood.rest[:, -1])
    controls = jnp.tile(jnp.array(COMMANDS[kind]), (STEPS, 1))
    expected = np.asarray(transition.sample_paths(by_path, states, controls, dt).body)
    for k in range(STEPS):
        mean = expected[:, k].mean(axis=0)
        here, there = (a - mean for a in (found[k], expected[:, k]))
        here[:, 2], there[:, 2] = wrap_angle(here[:, 2]), wrap_angle(there[:, 2])
        std = there.std(axis=0)
        assert (np.abs(here.mean(axis=0) - there.mean(axis=0)) < 4.5 * std / np.sqrt(ROBOTS)).all(), k
        assert (np.abs(here.std(axis=0) / std - 1.0) < 0.12).all(), k


@pytest.mark.slow
def test_the_same_seed_moves_robots_alike(tmp_path):
    file = saved(tmp_path, "holonomic")
    np.testing.assert_array_equal(imagined(file, "holonomic", 2), imagined(file, "holonomic", 2))


def test_a_robot_that_stops_stands(tmp_path):
    """A stop ends the motion that its drive would still make, as on the robot."""
    keywords = {"transition": saved(tmp_path, "holonomic"), "tasks": [task(START, (4.0, 1.2))]}
    env = make_vec(8, **keywords | EXACT)
    env.reset(seed=0)
    env.step(np.tile(np.float32([0.0, 0.0, 0.1, 1.0]), (8, 1)))
    np.testing.assert_allclose(env.planar, np.tile(START, (8, 1)), atol=1e-6)
    env.close()


@pytest.mark.slow
def test_a_transition_of_another_robot_is_refused(tmp_path):
    for file, message in (
        (saved(tmp_path, "car"), "kind: expected holonomic, the robot of this environment; found car"),
        (saved(tmp_path, "holonomic", further=1), "further: expected 3 controls"),
        (of_step(tmp_path, 0.1), "scales.step: expected 0.2 s, the robot's step; found 0.1"),
        (tmp_path / "none.npz", "a learned transition"),
        (3, "transition: expected a file"),
    ):
        with pytest.raises(InputError, match=message):
            make_vec(1, transition=file)
