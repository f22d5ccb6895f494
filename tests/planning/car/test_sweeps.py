"""Test the sweeps of value iteration: bands that are skipped change no bit, and products are added before rounding."""

import numpy as np
import pytest
from numba import njit

from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import Counts, PoseGrid, ValueConfig, sweeps
from vssm_gym.planning.value_iteration.fused import fused

SMALL = Car(wheelbase=0.05, track=0.04, length=0.09, width=0.05, rear_overhang=0.02, camera_forward=0.05)
COARSE = ValueConfig(n_headings=16, turns=(-1, 0, 1))
GAMMA, TOP = np.float32(0.99), np.float32(100.0)
CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))


def grid_of(seed: int, shape: tuple[int, int], resolution: float, priced: bool) -> PoseGrid:
    """Return a room, with random obstacles if cells are coarse; in a half of it motions count several times."""
    random = np.random.default_rng(seed)
    occupied = random.random(shape) < (0.05 if resolution > 0.01 else 0.0)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    poses = np.zeros((*shape, COARSE.n_headings), bool)
    poses[shape[0] // 2 :] = True
    counts = Counts(poses, np.array([3.0, 20.0], np.float32))
    arena = Arena.from_occupied(occupied, np.zeros(2), resolution)
    return PoseGrid.of(arena, SMALL, COARSE, counts if priced else None)


def plus(a: np.float32, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return ``a b + c``, rounded once to float32: in float64 the product is exact."""
    return (np.float64(a) * b.astype(np.float64) + c).astype(np.float32)


def by_hand(grid: PoseGrid, goal: np.ndarray, start: np.ndarray, n_sweeps: int) -> np.ndarray:
    """Sweep plane by plane and motion by motion: ``W = gamma max_a share_a sum_c w_c W_c``."""
    layout, problem = grid.layout, grid.problem
    edge = layout.pad + 8
    wide = np.zeros((COARSE.n_headings, layout.nx + 2 * edge, layout.ny + 2 * edge), np.float32)
    inside = np.s_[:, edge : edge + layout.nx, edge : edge + layout.ny]
    at_goal, allowed = layout.cells(goal), layout.cells(problem.allowed)
    wide[inside] = np.where(at_goal, TOP, layout.cells(start))
    for _ in range(n_sweeps):
        new = np.zeros(at_goal.shape, np.float32)
        for h in range(COARSE.n_headings):
            for a, (target, x, y) in enumerate(problem.ends[h]):
                around = [wide[target, edge + x + i :, edge + y + j :][: layout.nx, : layout.ny] for i, j in CORNERS]
                mean = problem.weights[h, a, 0] * around[0]
                for weight, corner in zip(problem.weights[h, a, 1:], around[1:], strict=True):
                    mean = plus(weight, corner, mean)
                if problem.priced is not None:
                    share = problem.shares[2 * a // len(problem.ends[h])]
                    mean = mean * np.where(layout.cells(problem.priced)[h], share, np.float32(1.0))
                new[h] = np.maximum(new[h], np.where(allowed[h] >> a & 1, mean, np.float32(0.0)))
        wide[inside] = np.where(at_goal, TOP, GAMMA * new)
    return wide[inside]


@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize("priced", [False, True])
@pytest.mark.parametrize(
    ("shape", "resolution"),
    [
        ((3 * sweeps.BAND_ROWS + 5, 21), 0.05),
        ((sweeps.BAND_ROWS, 30), 0.05),
        ((sweeps.BAND_ROWS - 1, 30), 0.05),
        ((10 * sweeps.BAND_ROWS, 60), 0.004),  # a motion crosses more than a band
    ],
)
def test_sweeps_are_those_by_hand_to_the_last_bit(
    shape: tuple[int, int], resolution: float, priced: bool, warm: bool
) -> None:
    """Compare 4, 8, .. 40 sweeps, of which many skip what stands; a limit is rounded up to a multiple of four."""
    grid = grid_of(1, shape, resolution, priced)
    layout = grid.layout
    free = layout.flat(np.moveaxis(~grid.blocked, -1, 0))
    goal = np.zeros_like(free)
    goal.flat[np.flatnonzero(free)[-3:]] = True  # in a corner, so that there is much to skip
    random = np.random.default_rng(2).uniform(0.0, 100.0, free.shape).astype(np.float32)
    start = np.where(free, random, np.float32(0.0)) if warm else np.zeros(free.shape, np.float32)
    for limit, done in ((1, 4), (5, 8), (40, 40)):
        found, residual, swept = sweeps.iterate(grid.problem, goal, start, layout, 0.99, float(TOP), 0.0, limit)
        assert swept == done or residual == 0.0
        np.testing.assert_array_equal(layout.cells(found), by_hand(grid, goal, start, swept))


@pytest.mark.parametrize("resolution", [0.05, 0.004])
def test_bands_that_stand_are_skipped(resolution: float) -> None:
    """Far from the goal nothing changes in the first sweep, and nothing at all after the last change."""
    grid = grid_of(3, (10 * sweeps.BAND_ROWS, 60), resolution, False)
    layout, margin = grid.layout, grid.layout.pad * grid.layout.row
    goal = layout.flat(np.moveaxis(~grid.blocked, -1, 0))
    goal[:, 30 * layout.row :] = False
    assert goal.any()
    planes = np.pad(np.where(goal, TOP, np.float32(0.0)), ((0, 0), (margin, margin)))
    other, moved = planes.copy(), np.ones((COARSE.n_headings, 10), bool)
    first = None
    for _ in range(400):
        moving = np.zeros_like(moved)
        sweeps._sweep(planes, other, moved, moving, goal, *grid.problem, tuple(layout), GAMMA, TOP, False)
        planes, other, moved = other, planes, moving
        first = moved if first is None else first
    assert first is not None and first.any() and not first[:, 6:].any()
    assert not moved.any()
    np.testing.assert_array_equal(planes, other)


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
