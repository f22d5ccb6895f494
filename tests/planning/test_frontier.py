"""Test frontiers on plans drawn by hand: their cells, groups, viewpoints and gains."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy import ndimage

from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.frontier import RAYS, frontier_cells, frontiers, seen_unknown, visible_unknown
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

CELL = 0.1  # m
SIGNS = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}
# Rows from the lowest y up: a corridor whose right end and whose side door lead on.
CORRIDOR = """
################
#..............?
#..............?
#..............?
#..............?
#..............?
#####.....######
?????.....??????
"""


def drawn(text: str) -> FloorPlan:
    """Return a plan from rows of signs, lowest y first."""
    rows = text.strip().splitlines()
    cells = np.array([[SIGNS[sign] for sign in row] for row in rows], np.int8).T
    depth = np.where(cells == OCCUPIED, 0.05, -0.05).astype(np.float32)
    return FloorPlan(np.ascontiguousarray(cells), depth, np.zeros(2), CELL)


def test_frontiers_of_a_corridor():
    plan = drawn(CORRIDOR)
    mask = frontier_cells(plan.cells)
    expected = {(14, j) for j in range(1, 6)} | {(5, 7), (9, 7)}
    assert {tuple(int(v) for v in cell) for cell in np.argwhere(mask)} == expected
    roadmap = Roadmap.of(plan, np.array([0.3, 0.3]), 0.15)
    found = frontiers(plan, roadmap.distance, least=1, near=0.35)
    assert sum(len(frontier.cells) for frontier in found) == len(expected)
    assert [frontier.distance for frontier in found] == sorted(frontier.distance for frontier in found)
    end = next(frontier for frontier in found if len(frontier.cells) == 5)
    # The goal stands as near to the middle of the end as a robot that needs 15 cm fits: it has that clearance.
    assert abs(end.goal[1] - 0.3) < 0.5 * CELL + 1e-9
    assert 1.1 < end.goal[0] <= 1.4
    assert end.distance == pytest.approx(np.linalg.norm(end.goal - [0.3, 0.3]), rel=0.03)
    assert roadmap.clearance.at(end.goal) >= 0.15


def test_a_robot_that_does_not_fit_finds_no_frontier():
    plan = drawn(CORRIDOR)
    roadmap = Roadmap.of(plan, np.array([0.3, 0.3]), 0.4)
    assert frontiers(plan, roadmap.distance, least=1) == []


def test_small_groups_and_dismissed_ones_are_left_out():
    plan = drawn(CORRIDOR)
    roadmap = Roadmap.of(plan, np.array([0.3, 0.3]), 0.15)
    assert [len(f.cells) for f in frontiers(plan, roadmap.distance, least=3, near=0.35)] == [5]
    (group,) = frontiers(plan, roadmap.distance, least=3, near=0.35)
    assert not frontiers(plan, roadmap.distance, least=3, near=0.35, dismissed=group.xy)


def test_unseen_parts_of_a_door_are_not_dismissed_with_the_seen_ones():
    plan = drawn("\n".join(["." * 20] * 4 + ["?" * 20]))
    roadmap = Roadmap.of(plan, np.array([0.3, 0.3]), 0.05)
    (door,) = frontiers(plan, roadmap.distance, length=10.0)
    half = door.xy[door.xy[:, 0] < door.xy[:, 0].mean()]
    (left,) = frontiers(plan, roadmap.distance, length=10.0, dismissed=half)
    assert len(half) - 3 <= len(left.cells) < len(door.cells)


def test_a_wide_frontier_is_divided():
    text = "\n".join(["." * 40] * 4 + ["?" * 40])
    plan = drawn(text)
    distance = np.zeros(plan.cells.shape, np.float32)
    found = frontiers(plan, distance, length=1.0)
    assert sorted(len(f.cells) for f in found) == [10, 10, 10, 10]
    assert all(np.ptp(f.xy[:, 0]) < 1.0 for f in found)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_frontier_cells_by_definition(seed):
    """They equal the definition, cell by cell, and a dilation of unknown space."""
    cells = np.random.default_rng(seed).choice([FREE, OCCUPIED, UNKNOWN], (9, 7)).astype(np.int8)
    beside = ndimage.binary_dilation(cells == UNKNOWN) & (cells != UNKNOWN)
    assert np.array_equal(frontier_cells(cells), beside & (cells == FREE))


def test_the_gain_of_a_doorway():
    """Through an opening of one cell straight ahead no cell beside the beam is seen, and walls end rays."""
    plan = drawn("\n".join(["??????????", "#####.####", "#........#", "#........#", "##########"][::-1]))
    seen = visible_unknown(plan.cells, 5.0, 2.0, 20.0, np.zeros(plan.cells.shape, np.float32), RAYS)
    assert set(np.unique(seen)) <= {0.0, 1.0}
    assert seen[5, 4] == 1.0
    assert seen[0, 4] == 0.0
    assert seen[:, :4].sum() == 0.0


def test_hazard_discounts_by_the_length_through_unknown_space():
    """In the open p = exp(-hazard * length), checked along an axis; zero hazard counts every cell in range once."""
    cells = np.full((41, 41), UNKNOWN, np.int8)
    plan = FloorPlan(cells, np.zeros(cells.shape, np.float32), np.zeros(2), CELL)
    p = visible_unknown(cells, 20.0, 20.0, 10.0, np.full(cells.shape, 0.2, np.float32), RAYS)
    for k in (1, 4, 9):
        assert p[20 + k, 20] == pytest.approx(math.exp(-0.2 * (k - 1)), rel=0.12)  # the robot's own cell is no way
    area = seen_unknown(plan, np.array([[2.0, 2.0]]), 0.0, 1.0).sum() * CELL**2
    assert area == pytest.approx(math.pi * 1.05**2, rel=0.05)  # of the cells that such rays cross
    less = seen_unknown(plan, np.array([[2.0, 2.0]]), 2.0, 1.0).sum() * CELL**2
    x, y = np.meshgrid(*[CELL * (np.arange(41) - 20)] * 2)
    away = np.hypot(x, y)
    expected = np.exp(-2.0 * np.maximum(away - CELL, 0.0))[away < 1.05].sum() * CELL**2
    assert less == pytest.approx(expected, rel=0.12)


def test_plans_without_known_or_without_unknown_cells():
    free = drawn("....\n....")
    assert frontiers(free, np.zeros(free.cells.shape, np.float32)) == []
    assert seen_unknown(free, np.array([[0.1, 0.1]])).shape == (1, 0)
    nowhere = np.full(free.cells.shape, np.inf, np.float32)
    assert frontiers(drawn("..??\n..??"), nowhere) == []
