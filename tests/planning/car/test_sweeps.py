"""Test the sweeps of value iteration: bands that are skipped change no bit, and products are added before rounding."""

import numpy as np
import pytest
from numba import njit

from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import PoseGrid, ValueConfig, sweeps
from vssm_gym.planning.value_iteration.fused import fused

SMALL = Car(wheelbase=0.05, track=0.04, length=0.09, width=0.05, rear_overhang=0.02, camera_forward=0.05)
COARSE = ValueConfig(n_headings=16, turns=(-1, 0, 1))
GAMMA, TOP = np.float32(0.99), np.float32(100.0)
SHAPE = (3 * sweeps.BAND_ROWS + 5, 21)


def grid_of(seed: int, priced: bool) -> PoseGrid:
    """Return a room with random obstacles; in a part of it motions count several times."""
    random = np.random.default_rng(seed)
    occupied = random.random(SHAPE) < 0.08
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    counts = np.ones((2, *SHAPE, COARSE.n_headings))
    counts[:, SHAPE[0] // 2 :] = np.array([3.0, 20.0])[:, None, None, None]
    return PoseGrid.of(Arena.from_occupied(occupied, np.zeros(2), 0.05), SMALL, COARSE, counts if priced else None)


def values_by_hand(grid: PoseGrid, goal: np.ndarray, n_sweeps: int) -> np.ndarray:
    """Sweep cell by cell and motion by motion in float64: ``W = gamma max_a share_a sum_c w_c W_c``."""
    layout, problem = grid.layout, grid.problem
    wide = np.zeros((COARSE.n_headings, layout.nx + 2 * layout.pad, layout.ny + 2 * layout.pad))
    inside = np.s_[:, layout.pad : layout.pad + layout.nx, layout.pad : layout.pad + layout.ny]
    at_goal, allowed = layout.cells(goal), layout.cells(problem.allowed)
    wide[inside] = np.where(at_goal, TOP, 0.0)
    for _ in range(n_sweeps):
        new = np.zeros(at_goal.shape)
        for h in range(COARSE.n_headings):
            for a, (target, x, y) in enumerate(problem.ends[h]):
                mean = np.zeros(at_goal.shape[1:])
                for weight, (dx, dy) in zip(problem.weights[h, a], ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
                    i, j = layout.pad + x + dx, layout.pad + y + dy
                    mean += np.float64(weight) * wide[target, i : i + layout.nx, j : j + layout.ny]
                if problem.shares is not None:
                    flat = problem.shares[h, 2 * a // len(problem.ends[h])]
                    mean *= layout.cells(flat[None])[0]
                new[h] = np.maximum(new[h], np.where(allowed[h] >> a & 1, mean, 0.0))
        wide[inside] = np.where(at_goal, TOP, 0.99 * new)
    return wide[inside]


@pytest.mark.parametrize("priced", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_sweeps_are_those_by_hand_and_skip_only_what_stands(seed: int, priced: bool) -> None:
    """Compare 4, 8, .. 40 sweeps with float64, and bit for bit with sweeps of all bands."""
    grid = grid_of(seed, priced)
    layout = grid.layout
    goal = layout.flat(np.moveaxis(grid.goal_poses(np.array([1.0, 0.5]), 0.12, 0.0), -1, 0))
    assert goal.any()
    margin = layout.pad * layout.row
    planes = np.pad(np.where(goal, TOP, np.float32(0.0)), ((0, 0), (margin, margin)))
    other = planes.copy()
    everything = np.ones((COARSE.n_headings, -(-layout.nx // sweeps.BAND_ROWS)), bool)
    skipped = 0
    for n in range(1, 41):
        moving = everything.copy()
        shape = layout.nx, layout.ny, layout.pad
        sweeps._sweep(planes, other, everything, moving, goal, *grid.problem, shape, GAMMA, TOP, False)
        planes, other = other, planes
        skipped += np.count_nonzero(~moving)
        if n % sweeps.CHECK_EVERY == 0:
            found, _, done = sweeps.iterate(
                grid.problem, goal, np.zeros(goal.shape), layout, 0.99, float(TOP), 0.0, max_sweeps=n
            )
            assert done == n
            np.testing.assert_array_equal(found, planes[:, margin : margin + layout.interior])
            np.testing.assert_allclose(layout.cells(found), values_by_hand(grid, goal, n), rtol=1e-5, atol=1e-20)
    assert skipped > 100


@njit
def multiply_add(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    out = np.empty_like(a)
    for i in range(len(a)):
        out[i] = fused(a[i], b[i], c[i])
    return out


def test_a_fused_sum_is_rounded_once() -> None:
    """``(1 + 2^-12)^2 - (1 + 2^-11)`` is ``2^-24``, which a product rounded to float32 has lost."""
    a, c = np.full(19, 1.0 + 2.0**-12, np.float32), np.full(19, -1.0 - 2.0**-11, np.float32)
    np.testing.assert_array_equal(a * a + c, 0.0)
    np.testing.assert_array_equal(multiply_add(a, a, c), np.float32(2.0**-24))
