"""Compare all implementations of the car's motion outside JAX with the bicycle's transition, in float64.

Planners that run in NumPy, numba or CasADi lay arcs of their own; this table names them all.
"""

import math
from collections.abc import Callable

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.agents.car.greedy import GreedyConfig, GreedyDescent
from vssm_gym.geometry import arc
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import Bicycle
from vssm_gym.planning.car import dwa, hybrid_astar, reeds_shepp
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.car.hybrid_search import advance
from vssm_gym.planning.mpc.symbols import bicycle_step
from vssm_gym.planning.value_iteration import Motions

CAR = Car()
SPEEDS, STEERINGS = np.array([0.6, -0.6, 0.3, -0.05, 0.0]), np.linspace(-CAR.max_steering, CAR.max_steering, 9)


def law(poses: np.ndarray, controls: np.ndarray, seconds: np.ndarray | float) -> np.ndarray:
    """Return ``Bicycle.mean`` in float64, ``(..., 3)``."""
    with jax.enable_x64(True):
        bicycle = Bicycle(wheelbase=CAR.wheelbase)
        arguments = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (poses, np.zeros(poses.shape))))
        mean = jax.jit(lambda z, u, dt: bicycle.mean(z, u, dt))
        return np.asarray(mean(jnp.asarray(arguments[0]), jnp.asarray(controls), jnp.asarray(seconds)), np.float64)


def assert_same(poses: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Compare metres and radians, headings modulo a turn."""
    assert poses.shape == expected.shape
    np.testing.assert_allclose(poses[..., :2], expected[..., :2], rtol=0.0, atol=tolerance)
    assert np.abs(np.exp(1j * poses[..., 2]) - np.exp(1j * expected[..., 2])).max() <= tolerance


def drawn(n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Draw poses and controls of all kinds, including steps at rest and straight ones."""
    rng = np.random.default_rng(0)
    poses = rng.uniform([-5.0, -5.0, -3.1], [5.0, 5.0, 3.1], (n, 3))
    controls = np.stack([rng.choice(SPEEDS, n), rng.choice([*STEERINGS, 1e-4], n)], axis=-1)
    return poses, controls


def numpy_arcs() -> tuple[np.ndarray, np.ndarray]:
    poses, controls = drawn()
    s = controls[:, 0] * CAR.dt
    turn = arc.turn_of(s, controls[:, 1], CAR.wheelbase)
    return arc.poses_after(poses[:, 2], s, turn, poses[:, 0], poses[:, 1]), law(poses, controls, CAR.dt)


def numba_arcs() -> tuple[np.ndarray, np.ndarray]:
    """Return arcs with the exact chord."""
    poses, controls = drawn()
    s = controls[:, 0] * CAR.dt
    turn = arc.turn_of(s, controls[:, 1], CAR.wheelbase)
    chord = arc.chord_of(s, turn)
    moved = [arc.pose_after(*pose, c, t) for pose, c, t in zip(poses, chord, turn, strict=True)]
    return np.array(moved), law(poses, controls, CAR.dt)


def casadi_symbols() -> tuple[np.ndarray, np.ndarray]:
    poses, controls = drawn()
    z, u = casadi.MX.sym("z", 3, len(poses)), casadi.MX.sym("u", 2, len(poses))
    moved = casadi.Function("step", [z, u], [bicycle_step(casadi, z, u, CAR.dt, CAR.wheelbase)])
    return np.asarray(moved(poses.T, controls.T)).T, law(poses, controls, CAR.dt)


def value_iteration_motions() -> tuple[np.ndarray, np.ndarray]:
    """Return the motions from every heading of several grids."""
    found, expected = [], []
    for n_headings, turns in ((8, (-1, 0, 1)), (16, (0, 2)), (64, (-3, -1, 0, 1, 3))):
        motions = Motions.of(CAR, n_headings, turns)
        assert np.abs(motions.controls[:, 1]).max() == pytest.approx(CAR.max_steering)
        shares = np.array([0.0, 0.37, 1.0])
        poses = motions.along(shares)
        start = np.zeros(poses.shape)
        start[..., 2] = 2.0 * np.pi / n_headings * np.arange(n_headings)[:, None, None]
        controls = np.broadcast_to(motions.controls[:, None], (*poses.shape[:-1], 2))
        found.append(poses.reshape(-1, 3))
        expected.append(law(start, controls, shares * motions.length / CAR.max_speed).reshape(-1, 3))
    return np.concatenate(found), np.concatenate(expected)


def hybrid_astar_arcs() -> tuple[np.ndarray, np.ndarray]:
    """Return the displacements of a search's arcs, applied as the search applies them."""
    radius, step = 1.2 * CAR.turning_radius, 0.15
    moves = hybrid_astar.arcs(step, radius, 5, 0.04)
    pose = np.array([1.0, -2.0, 0.7])
    count = moves.displacement.shape[1]
    found = np.array([[advance(pose, d) for d in row] for row in moves.displacement])
    steering = np.arctan(CAR.wheelbase * moves.steering / radius)
    controls = np.stack([moves.gear, steering], axis=-1)[:, None].repeat(count, axis=1)
    seconds = np.broadcast_to(step * np.arange(1, count + 1) / count, controls.shape[:-1])
    return found, law(np.broadcast_to(pose, found.shape), controls, seconds)


def reeds_shepp_curves() -> tuple[np.ndarray, np.ndarray]:
    """Return sampled curves of one segment each."""
    radius, start = 0.6, np.array([0.3, 0.2, -2.0])
    found, expected = [], []
    for length in (0.9, -0.4):
        for side in (1, 0, -1):
            curve = reeds_shepp.ReedsSheppPath(start, np.array([length]), np.array([side], np.int8), radius)
            poses, _ = reeds_shepp.sample(curve, 0.05)
            seconds = np.abs(length) * np.arange(len(poses)) / (len(poses) - 1)
            control = [math.copysign(1.0, length), math.atan(CAR.wheelbase * side / radius)]
            found.append(poses)
            expected.append(law(np.broadcast_to(start, poses.shape), np.tile(control, (len(poses), 1)), seconds))
    return np.concatenate(found), np.concatenate(expected)


def greedy_arcs() -> tuple[np.ndarray, np.ndarray]:
    arena = Arena.from_occupied(np.zeros((20, 20), bool), np.zeros(2), 0.05)
    descent, pose = GreedyDescent(arena, CAR, GreedyConfig()), np.array([0.5, 0.4, 2.9])
    found = descent._along(pose)
    controls = np.stack([np.sign(descent._length), descent._steering], axis=-1)[:, None].repeat(found.shape[1], axis=1)
    shares = np.arange(1, found.shape[1] + 1) / found.shape[1]
    return found, law(np.broadcast_to(pose, found.shape), controls, np.abs(descent._length)[:, None] * shares)


EXACT: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
    twin.__name__: twin
    for twin in (
        numpy_arcs,
        numba_arcs,
        casadi_symbols,
        value_iteration_motions,
        hybrid_astar_arcs,
        reeds_shepp_curves,
        greedy_arcs,
    )
}


@pytest.mark.parametrize("name", EXACT)
def test_an_implementation_moves_as_the_transition_does(name):
    found, expected = EXACT[name]()
    assert len(found) >= 6
    assert_same(found, expected, 1e-9)


@pytest.mark.parametrize(
    ("part", "chord", "most"),
    [
        (0.035, lambda s, turn: s * (1.0 - turn * turn / 24.0), 1e-6),  # curves of hybrid A*, parts of one cell
        (dwa._PART, lambda s, turn: s, 5e-4),  # the dynamic window's arcs
    ],
)
def test_short_parts_add_up_to_an_arc(part, chord, most):
    """The approximate chords of the compiled searches, over 1.2 m at full lock, end at the end of the arc."""
    for steering in (CAR.max_steering, -0.2):
        for gear in (1.0, -1.0):
            pose, count = (0.3, 0.2, 1.0), round(1.2 / part)
            turn = float(arc.turn_of(gear * part, steering, CAR.wheelbase))
            for _ in range(count):
                pose = arc.pose_after(*pose, chord(gear * part, turn), turn)
            expected = law(np.array([[0.3, 0.2, 1.0]]), np.array([[gear, steering]]), count * part)
            assert_same(np.array([pose]), expected, most)
