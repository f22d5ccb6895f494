"""Test augmented random search: a toy objective, the moments of states, and rollouts against plain NumPy."""

import math

import numpy as np
import pytest

from vssm_gym.agents.shared.planar.lstm_policy import (
    LstmPolicy,
    load_lstm,
    read_inputs,
    save_lstm,
    size_of,
    unpacked,
)
from vssm_gym.envs.physics.planar import scan, slide
from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.envs.tasks.maze_objectives import MazeCoverage
from vssm_gym.envs.tasks.mazes import ROBOT, load_maze
from vssm_gym.envs.tasks.navigation import Task
from vssm_gym.errors import InputError
from vssm_gym.training.random_search.maze_rollouts import draws, rollouts, starts_of
from vssm_gym.training.random_search.search import Moments, SearchConfig, climb
from vssm_gym.training.random_search.train_maze_lstm import LstmTraining, train

LIMITS = ROBOT.limits[[0, 2]].astype(np.float64)


def policy(inputs: int = 8, hidden: int = 5, seed: int = 0) -> LstmPolicy:
    rng = np.random.default_rng(seed)
    numbers = 0.3 * rng.normal(size=size_of(inputs, hidden))
    return LstmPolicy(inputs, hidden, numbers, rng.uniform(0.2, 0.4, inputs), rng.uniform(0.1, 0.3, inputs))


def test_random_search_climbs_a_toy_objective():
    """-|theta - target|^2 in ten dimensions; its gain does not depend on the scale of the reward."""
    target = np.linspace(-1.0, 1.0, 10)
    for scale in (1.0, 1e3):
        rng, theta, moments = np.random.default_rng(0), np.zeros(10), Moments.of(3)

        def evaluate(sides, moments, scale=scale):
            return -scale * ((sides - target) ** 2).sum(axis=1), Moments.of(3)

        for _ in range(200):
            theta, moments, _ = climb(theta, moments, evaluate, SearchConfig(8, 4, 0.05, 0.05), rng)
        assert np.abs(theta - target).max() < 0.15


def test_only_the_best_directions_move_the_parameters():
    """With one of many, the step is along that direction alone, of length alpha (r+ - r-) / s |delta| = 2 alpha."""
    rng = np.random.default_rng(3)
    drawn = np.random.default_rng(3).normal(size=(6, 4))
    evaluate = lambda sides, moments: (sides @ np.array([1.0, 2.0, 3.0, 4.0]), Moments.of(2))
    moved, _, _ = climb(np.zeros(4), Moments.of(2), evaluate, SearchConfig(6, 1, 0.1, 0.5), rng)
    slopes = drawn @ np.array([1.0, 2.0, 3.0, 4.0])
    k = int(np.argmax(np.abs(slopes)))
    np.testing.assert_allclose(moved, 0.5 * 2.0 * np.sign(slopes[k]) * drawn[k], rtol=1e-9)


def test_moments_are_those_of_all_states():
    states = np.random.default_rng(0).normal(3.0, 2.0, (500, 4))
    parts = [Moments(float(len(part)), part.sum(axis=0), (part**2).sum(axis=0)) for part in np.split(states, 5)]
    total = sum(parts, Moments.of(4))
    np.testing.assert_allclose(total.mean, states.mean(axis=0))
    np.testing.assert_allclose(total.std, states.std(axis=0))
    np.testing.assert_array_equal(Moments.of(4).std, np.ones(4))


def test_the_forward_pass_is_that_of_an_lstm():
    """Against the equations, gate by gate and unit by unit."""
    p, rng = policy(), np.random.default_rng(1)
    W, b, V, d = unpacked(p.parameters, p.inputs, p.hidden)
    state, h, c = p.start(), np.zeros(p.hidden), np.zeros(p.hidden)
    sigmoid = lambda x: 1.0 / (1.0 + math.exp(-x))
    for _ in range(4):
        ranges = rng.uniform(0.0, 1.0, p.inputs)
        joined = [*((ranges - p.mean) / p.std), *h]
        gate = [sum(W[k, j] * joined[j] for j in range(len(joined))) + b[k] for k in range(4 * p.hidden)]
        for k in range(p.hidden):
            i, f, g, o = (gate[n * p.hidden + k] for n in range(4))
            c[k] = sigmoid(f) * c[k] + sigmoid(i) * math.tanh(g)
            h[k] = sigmoid(o) * math.tanh(c[k])
        state, command = p.step(state, ranges, LIMITS)
        np.testing.assert_allclose(state, [h, c], rtol=1e-9)
        a = V @ h + d
        np.testing.assert_allclose(command, [LIMITS[0] * math.tanh(a[0]), LIMITS[1] * sigmoid(a[1])], rtol=1e-9)


def test_a_rollout_is_an_episode_of_the_maze():
    """Step by step as LidarMaze: the robot's noise and contacts, ranges with noise, the tiles that count."""
    maze, p, steps = load_maze("rooms-v1"), policy(), 120
    rng = np.random.default_rng(2)
    places = np.array([[0.1, 0.1], [0.9, 0.9]])
    starts = starts_of(rng, places, 4)
    motion, noise = draws(rng, 4, steps, p.inputs, (0.02, 0.002), 0.01)
    np.testing.assert_array_equal(starts[::2], starts[1::2])
    counted = MazeCoverage(maze.space).counted
    tried = np.stack([p.parameters * factor for factor in (1.0, -1.0, 2.0, 0.5)])
    given = p.mean, p.std, p.hidden, starts, maze.rectangles, counted, motion, noise, LIMITS, ROBOT.radius, 1.5
    found, sums = rollouts(tried, *given)

    for k, numbers in enumerate(tried):
        one = LstmPolicy(p.inputs, p.hidden, numbers, p.mean, p.std)
        state, pose, coverage = one.start(), starts[k].copy(), MazeCoverage(maze.space)
        coverage.begin(Task.model_construct(start=tuple(pose)))
        for t in range(steps):
            ranges = scan(pose[None], maze.rectangles, p.inputs)[0] + noise[k, t]
            state, (turn, step) = one.step(state, np.where((ranges <= 0.0) | (ranges > 1.5), 1.5, ranges), LIMITS)
            e, by = motion[k, t]
            phi, moved = pose[2] + e, max(0.0, step + by)
            x, y, _ = slide(
                pose[0], pose[1], moved * math.cos(phi), moved * math.sin(phi), ROBOT.radius, maze.rectangles
            )
            pose = np.array([x, y, pose[2] + math.copysign(max(0.0, abs(turn) + e), turn)])
            coverage.gained(pose[:2])
        np.testing.assert_allclose(found[k], coverage.ratio)
    assert sums[0, 0] == 4 * steps and (sums[1] > 0.0).all()
    exact = execute(starts[0], np.array([0.1, 0.0, 0.01]), ExecutionNoise(0.0, 0.0), np.random.default_rng(0))
    np.testing.assert_allclose(exact[2], starts[0, 2] + 0.1)


def test_a_training_improves_and_repeats():
    short = LstmTraining(iterations=50, steps=60, hidden=4, inputs=8, search=SearchConfig(4, 2, 0.1, 0.1))
    checks = []
    first = train("pillars-v1", short, lambda *one: checks.append(one))
    again = train("pillars-v1", short)
    np.testing.assert_array_equal(first.parameters, again.parameters)
    assert checks[-1][0] == 50 and first.trained["coverage"] > 0.03
    assert first.trained["maze"] == "pillars-v1"


def test_a_policy_survives_its_file(tmp_path):
    p = policy()
    save_lstm(tmp_path / "p.npz", p)
    again = load_lstm(tmp_path / "p.npz")
    np.testing.assert_allclose(again.parameters, p.parameters, rtol=1e-6)
    assert (again.inputs, again.hidden) == (p.inputs, p.hidden)
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    with pytest.raises(InputError):
        load_lstm(tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", header=np.frombuffer(b'{"format": "x"}', np.uint8))
    with pytest.raises(InputError, match="version"):
        load_lstm(tmp_path / "other.npz")
    with pytest.raises(InputError, match="parameters: expected"):
        LstmPolicy(8, 5, np.zeros(3), np.zeros(8), np.ones(8))
    with pytest.raises(InputError, match="a multiple of 5 readings; found 64"):
        read_inputs(np.ones(64), 5, 1.5)


def test_bad_searches_are_refused():
    with pytest.raises(InputError, match="best: expected 1 to 4, not 5"):
        SearchConfig(4, 5)
    with pytest.raises(InputError, match="rate: expected above 0"):
        SearchConfig(rate=0.0)
