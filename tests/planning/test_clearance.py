"""Test clearance: exact for straight surfaces, 1-Lipschitz on any grid, and obstacles in unobserved space."""

import hypothesis.strategies as st
import numpy as np
import pytest
import shapely
from hypothesis import given

from tests.helpers.planning_worlds import clearance_map, grids, signed_depth, voxel_map
from vssm_gym.planning.clearance import OUTSIDE, ClearanceMap

ROOM = shapely.box(0.0, 0.0, 3.0, 2.0)


@given(st.floats(0.0, np.pi), st.floats(-0.3, 0.3))
def test_distance_to_a_straight_wall(angle, offset):
    """The only error of a half-plane is the spacing of the zero crossings along its border."""
    resolution = 0.025
    x, y = np.meshgrid(np.arange(-1.0, 1.0, resolution), np.arange(-1.0, 1.0, resolution), indexing="ij")
    depth = np.cos(angle) * x + np.sin(angle) * y - offset
    found = ClearanceMap.from_occupancy(depth, np.array([-1.0, -1.0]), resolution)
    middle = np.hypot(x, y) < 0.6  # away from where the grid cuts the wall off
    error = (np.abs(found.clearance) - np.abs(depth))[middle]
    assert error.min() > -1e-6
    assert np.all(error <= np.hypot(depth, 0.71 * resolution)[middle] - np.abs(depth)[middle] + 1e-6)


def of_cells(occupied: np.ndarray, resolution: float) -> np.ndarray:
    """Return the clearance of surfaces halfway between occupied and free centres."""
    return ClearanceMap.from_occupancy(np.where(occupied, resolution, -resolution), np.zeros(2), resolution).clearance


@given(grids())
def test_signed_and_lipschitz(occupied):
    """Clearance is positive exactly in free cells, and changes between neighbours by at most their distance."""
    clearance = of_cells(occupied, 0.1)
    assert np.array_equal(clearance > 0.0, ~occupied)
    for axis in (0, 1):
        assert np.abs(np.diff(clearance, axis=axis)).max() <= 0.1 + 1e-6


@given(grids(), st.integers(0, 2**32 - 1))
def test_distance_of_cells_is_within_half_a_cell_of_brute_force(occupied, seed):
    clearance = of_cells(occupied, 1.0)
    free, solid = np.argwhere(~occupied), np.argwhere(occupied)
    if len(free) and len(solid):
        between_centres = np.linalg.norm(free[:, None] - solid[None], axis=-1).min(axis=1)
        error = clearance[~occupied] - (between_centres - 0.5)
        assert np.abs(error).max() < 0.5


def test_no_obstacle_and_no_free_cell():
    empty = of_cells(np.zeros((4, 5), bool), 0.1)
    full = of_cells(np.ones((4, 5), bool), 0.1)
    assert np.isfinite(empty).all()
    assert (empty > 0.5).all()
    assert (full < -0.5).all()


@given(st.lists(st.tuples(st.floats(-0.3, 3.3), st.floats(-0.3, 2.3)), min_size=1, max_size=20))
def test_at_interpolates(points):
    """``at`` is the stored value on cells, Lipschitz between them, and OUTSIDE beyond the grid."""
    plan = clearance_map(ROOM, shapely.box(1.0, 1.0, 1.5, 1.4))
    xy = np.array(points)
    shape = np.array(plan.clearance.shape)
    inside = np.all(np.abs(plan.to_grid(xy) - (shape - 1) / 2) < (shape - 1) / 2 - 1e-6, axis=1)
    cell = np.clip(np.round(plan.to_grid(xy)).astype(int), 0, shape - 1)
    away = np.linalg.norm(plan.to_world(cell) - xy, axis=1)
    difference = np.abs(plan.at(xy) - plan.clearance[tuple(cell.T)])
    assert np.all(difference[inside] <= np.sqrt(2.0) * away[inside] + 1e-6)
    beyond = np.any(np.abs(plan.to_grid(xy) - (shape - 1) / 2) > (shape - 1) / 2 + 1e-6, axis=1)  # not the rim
    assert np.all(plan.at(xy)[beyond] == OUTSIDE)
    assert np.allclose(plan.at(plan.to_world(cell)), plan.clearance[tuple(cell.T)], atol=1e-6)


def test_an_added_obstacle_only_lowers_clearance():
    plan = clearance_map(ROOM, shapely.box(1.0, 1.0, 1.5, 1.4))
    closer = plan.with_obstacle(np.array([2.0, 0.5]), 0.03)
    assert np.all(closer.clearance <= plan.clearance)
    assert closer.at(np.array([2.0, 0.5])) == pytest.approx(-0.03, abs=0.02)
    assert closer.at(np.array([2.2, 0.5])) == pytest.approx(0.17, abs=1e-2)


@pytest.fixture(scope="module")
def learned():
    """Return a room with a thin wall, a table top at robot height, a lamp above, a rug below, and an unseen corner."""
    solids = [
        (shapely.box(1.45, 0.0, 1.55, 1.2), 0.0, 1.0),
        (shapely.box(2.0, 0.2, 2.6, 0.8), 0.35, 0.47),
        (shapely.box(2.0, 1.4, 2.6, 1.8), 0.6, 0.9),
        (shapely.box(0.2, 1.4, 0.6, 1.8), 0.0, 0.03),
    ]
    return voxel_map(ROOM, solids, lambda x, y, z: (x > 0.5) | (y > 0.5))


def test_learned_clearance_is_that_of_the_floor_plan(learned):
    """Wherever a robot fits, on both sides of a 10 cm wall, it is within a centimetre of the exact plan's."""
    found = ClearanceMap.from_voxel_map(learned)
    solid = shapely.union_all(
        [shapely.box(1.45, 0.0, 1.55, 1.2), shapely.box(2.0, 0.2, 2.6, 0.8), shapely.box(0.0, 0.0, 0.5, 0.5)]
    )
    blocked = solid | (ROOM.buffer(1.0) - ROOM)
    x, y = np.meshgrid(np.arange(0.1, 2.95, 0.04), np.arange(0.1, 1.95, 0.04), indexing="ij")
    exact = -signed_depth(blocked, x, y)
    error = found.at(np.stack([x, y], axis=-1)) - exact
    near = (exact > 0.05) & (exact < 0.5)
    dark = np.hypot(np.maximum(x - 0.5, 0.0), np.maximum(y - 0.5, 0.0)) < 0.5  # its border is known to a voxel only
    assert np.abs(error[near & ~dark]).max() < 0.02
    assert np.abs(error[near & ~dark]).mean() < 0.005
    assert np.abs(error[near & dark]).max() < 0.06


def test_what_counts_as_an_obstacle(learned):
    found = ClearanceMap.from_voxel_map(learned)
    places = {"wall": (1.5, 0.6), "table top": (2.3, 0.5), "never observed": (0.2, 0.2)}
    for name, xy in places.items():
        assert found.at(np.array(xy)) < 0.0, name
    for name, xy in {"under the lamp": (2.3, 1.6), "on the rug": (0.4, 1.6)}.items():
        assert found.at(np.array(xy)) > 0.15, name


def test_an_unobserved_map_has_no_free_place():
    learned = voxel_map(ROOM, [], lambda x, y, z: np.zeros(np.broadcast_shapes(x.shape, z.shape), bool))
    assert (ClearanceMap.from_voxel_map(learned).clearance < 0.0).all()
