"""Test the controllers in closed loop: value iteration, noise on speed and steering, boxes, a chain of targets."""

import numpy as np
import pytest
import shapely
from shapely import affinity

from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.mpc import safety
from vssm_gym.planning.mpc.ipopt import Ipopt
from vssm_gym.planning.mpc.mppi import Mppi
from vssm_gym.planning.mpc.problem import MpcConfig, MpcProblem
from vssm_gym.planning.mpc.random_search import RandomSearch
from vssm_gym.planning.value_iteration import PoseGrid, ValueConfig, solve

SIZE = np.array([3.2, 2.4])  # m
BOXES = [
    (0.9, 0.8, 0.3, 0.3, 0.2),
    (2.2, 0.7, 1.0, 0.4, 0.15),
    (1.6, 1.8, 0.0, 0.25, 0.25),
]  # x, y, angle, length, width
CELL, MARGIN = 0.035, 0.03
TARGETS, STEPS, REACHED = 8, 600, 0.10
SPEED_NOISE, STEERING_NOISE = 0.05, np.radians(2.0)
PROBLEM = MpcProblem(config=MpcConfig(deadline=float("inf")))  # the test's machine may be busy


def obstacles() -> shapely.Geometry:
    outside = shapely.box(-1.0, -1.0, *(SIZE + 1.0)) - shapely.box(0.0, 0.0, *SIZE)
    boxes = [
        affinity.rotate(shapely.box(x - a / 2, y - b / 2, x + a / 2, y + b / 2), angle, use_radians=True)
        for x, y, angle, a, b in BOXES
    ]
    return shapely.union_all([outside, *boxes])


def noisy_step(state: np.ndarray, control: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the arc of the command as this car executes it."""
    car, (speed, steering) = PROBLEM.car, control
    s = speed * (1.0 + SPEED_NOISE * rng.standard_normal()) * car.dt
    turn = s * np.tan(steering + STEERING_NOISE * rng.standard_normal()) / car.wheelbase
    forward, left = s * np.sinc(turn / np.pi), s * turn / 2 * np.sinc(turn / 2 / np.pi) ** 2
    c, n = np.cos(state[2]), np.sin(state[2])
    return np.array([state[0] + c * forward - n * left, state[1] + n * forward + c * left, state[2] + turn])


@pytest.mark.slow
@pytest.mark.parametrize("make", [RandomSearch, Ipopt, Mppi])
def test_targets_are_reached_without_a_collision(make) -> None:
    solid, solver = obstacles(), make(PROBLEM)
    axes = [np.arange(-0.2, n + 0.2, CELL) for n in SIZE]
    x, y = np.meshgrid(*axes, indexing="ij")
    arena = Arena.from_occupied(shapely.intersects_xy(solid, x, y), np.array([-0.2, -0.2]), CELL)
    grid = PoseGrid.of(arena, PROBLEM.car, ValueConfig(margin=MARGIN))
    rng, state, reached, collisions, asked = np.random.default_rng(3), np.array([0.4, 1.6, 0.5]), 0, 0, 0
    while asked < TARGETS:
        target = rng.uniform([0.25, 0.25], SIZE - 0.25)
        found = solve(grid, target, start=state)
        if not found.solved:
            continue
        asked += 1
        memory, hit = safety.init(np.zeros(2)), False
        for _ in range(STEPS):
            result = solver.plan(state, found.cost_to_go, arena.clearance, memory.resume, memory.control)
            memory, action = safety.step(PROBLEM, memory, result, state, arena.clearance)
            state = noisy_step(state, action.control, rng)
            hit |= shapely.Polygon(PROBLEM.car.corners(state)).intersects(solid)
            if np.hypot(*(state[:2] - target)) <= REACHED:
                reached += 1
                break
        collisions += hit
    assert (reached, collisions) == (TARGETS, 0)
