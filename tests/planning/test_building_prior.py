"""Test the prior of unknown space: the outline of a building that stands at any angle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.building_prior import (
    COMPARED_TURNS,
    expected_surfaces,
    main_direction,
    outline,
    over_map,
)
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

CELL = 0.05  # m
STEP = 0.5 * math.pi / COMPARED_TURNS


def plan(cells: np.ndarray) -> FloorPlan:
    return FloorPlan(cells, np.zeros(cells.shape, np.float32), np.array([-3.0, 1.0]), CELL)


def corner(angle: float, size: int = 160) -> FloorPlan:
    """Return two walls at a right angle, 10 cm thick, 2.5 and 2 m long from a corner; all else is unknown."""
    xy = (np.stack(np.meshgrid(*2 * [np.arange(size)], indexing="ij"), axis=-1) - 0.5 * size) * CELL
    along, across = xy @ (math.cos(angle), math.sin(angle)), xy @ (-math.sin(angle), math.cos(angle))
    wall = (np.abs(across) <= 0.05) & (along > -0.05) & (along < 2.5)
    wall |= (np.abs(along) <= 0.05) & (across > -0.05) & (across < 2.0)
    return plan(np.where(wall, OCCUPIED, UNKNOWN).astype(np.int8))


@given(angle=st.floats(0.0, 0.5 * math.pi - 1e-6))
def test_the_main_direction_is_that_of_the_walls(angle: float) -> None:
    off = abs(main_direction(corner(angle)) - angle)
    assert min(off, 0.5 * math.pi - off) <= 1.01 * STEP


@pytest.mark.parametrize("angle", [0.0, 3 * STEP, 17 * STEP])
def test_the_outline_closes_two_walls_to_a_rectangle(angle: float) -> None:
    inside = outline(corner(angle))
    middle = 0.5 * np.array(inside.shape)

    def at(along: float, across: float) -> bool:
        x = along * math.cos(angle) - across * math.sin(angle)
        y = along * math.sin(angle) + across * math.cos(angle)
        return bool(inside[tuple(np.floor(middle + np.array([x, y]) / CELL + 0.5).astype(int))])

    assert at(2.3, 1.8) and at(0.1, 0.1) and at(1.2, 1.0)  # the first lies 2.9 m from the corner, where nothing is
    assert not at(2.8, 1.0) and not at(1.0, 2.3) and not at(-0.3, 1.0) and not at(1.0, -0.3)
    assert inside.sum() * CELL**2 == pytest.approx(2.5 * 2.0, rel=0.1)


def test_the_outline_grows_with_known_space() -> None:
    before = corner(0.0)
    cells = before.cells.copy()
    cells[10:12, 100] = FREE
    after = outline(plan(cells))
    assert (outline(before) <= after).all()
    assert after[10, 80] and not outline(before)[10, 80]


def test_an_unknown_plan_has_no_outline() -> None:
    empty = plan(np.full((40, 30), UNKNOWN, np.int8))
    np.testing.assert_array_equal(expected_surfaces(empty, 0.5, 3.0), np.float32(0.5))
    h = expected_surfaces(corner(0.0), 0.5, 3.0)
    assert h.dtype == np.float32
    assert set(np.unique(h).tolist()) == {0.5, 3.0}


def test_values_of_a_plan_lie_where_its_cells_do() -> None:
    m = VoxelMap.prior(np.array([-4.0, 0.0, 0.0]), CELL, (80, 80, 8))
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    columns = over_map(plan(np.zeros((3, 4), np.int8)), values, -1.0, m)
    np.testing.assert_array_equal(columns[20:23, 20:24], values)
    assert (columns == -1.0).sum() == columns.size - values.size
