"""Test the footprint against polygons: exact collisions on grids, covering discs, treatments of unknown space."""

import hypothesis.strategies as st
import numpy as np
import pytest
import shapely
from hypothesis import given

from tests.helpers.planning_worlds import VOXEL, grids, voxel_map
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import (
    Arena,
    Kernel,
    arena_from_map,
    cells_under,
    dilate,
    heading_grid,
    rectangle_collisions,
)

CAR = Car()


def rectangle(planar: np.ndarray, margin: float = 0.0) -> shapely.Polygon:
    """Return the footprint of one pose, grown by ``margin`` on its four sides and not rounded."""
    return shapely.Polygon(CAR.corners(planar)).buffer(margin, join_style="mitre")


def squares(occupied: np.ndarray, resolution: float) -> shapely.Geometry:
    """Return the occupied cells and everything beyond the grid."""
    at = resolution * np.argwhere(occupied)
    half = 0.5 * resolution
    cells = shapely.box(*(at - half).T, *(at + half).T)
    grid = shapely.box(-half, -half, *(resolution * np.array(occupied.shape) - half))
    return shapely.union_all([*cells, grid.buffer(3.0) - grid])


@given(
    grids(),
    st.sampled_from([0.035, 0.05, 0.11]),
    st.sampled_from([0.0, 0.02]),
    st.lists(st.floats(-7.0, 7.0), min_size=1, max_size=3),
)
def test_collisions_are_those_of_the_polygons(occupied, resolution, margin, headings):
    found = rectangle_collisions(occupied, resolution, CAR, np.array(headings), margin)
    obstacles = squares(occupied, resolution)
    poses = [[resolution * i, resolution * j, h] for i, j in np.ndindex(occupied.shape) for h in headings]
    overlap = shapely.area(shapely.intersection(obstacles, [rectangle(np.array(p), margin) for p in poses]))
    overlap = overlap.reshape(found.shape)
    assert found[overlap > 1e-6].all()
    assert not found[overlap < 1e-12].any()


def test_contact_without_overlap_is_no_collision():
    """With cells of 1 cm half the width is 9.5 cells, so that sides coincide with borders of cells."""
    occupied = np.zeros((91, 61), bool)
    occupied[:, 20] = True
    free = ~rectangle_collisions(occupied, 0.01, CAR, heading_grid(4))[30, :, 0]
    assert np.flatnonzero(free).tolist() == [9, 10, *range(30, 52)]  # between borders and the line of cells


def test_several_poses_are_their_union():
    planar = np.array([[0.0, 0.0, 0.3], [0.05, 0.02, 0.5], [0.1, 0.05, 0.7]])
    union = cells_under(planar, 0.035, CAR, 0.0)
    occupied = np.random.default_rng(0).random((60, 50)) < 0.01
    each = [dilate(occupied, [Kernel.of(cells_under(p[None], 0.035, CAR, 0.0))])[0] for p in planar]
    assert np.array_equal(dilate(occupied, [Kernel.of(union)])[0], np.any(each, axis=0))


@pytest.fixture(scope="module")
def half_seen_room():
    """Return a room of 2 x 1.4 m with a box; nothing is observed beyond x = 1.4 m."""
    box = shapely.box(0.5, 0.5, 0.7, 0.8)
    return voxel_map(shapely.box(0.0, 0.0, 2.0, 1.4), [(box, 0.0, 0.3)], observed=lambda x, y, z: x < 1.4)


def at(arena: Arena, x: float, y: float) -> tuple[bool, float]:
    cell = tuple(np.round((np.array([x, y]) - arena.origin) / arena.resolution).astype(int))
    return bool(arena.occupied[cell]), float(arena.clearance.at(np.array([x, y])))


BOUNDS = np.array([[-0.1, -0.1], [2.1, 1.5]])


def test_treatments_of_unknown_space(half_seen_room):
    mean, optimistic, averse = (
        arena_from_map(half_seen_room, u, bounds=BOUNDS) for u in ("mean", "optimistic", "averse")
    )
    for arena in (mean, optimistic, averse):
        assert at(arena, 0.6, 0.65)[0]  # the box
        assert at(arena, 0.6, 0.65)[1] < 0.0
        occupied, clearance = at(arena, 1.0, 0.3)
        assert not occupied
        assert clearance == pytest.approx(0.3, abs=0.03)
    assert at(mean, 1.7, 0.7)[0]
    assert at(averse, 1.7, 0.7)[0]
    assert not at(optimistic, 1.7, 0.7)[0]
    assert np.all(mean.occupied >= optimistic.occupied)
    assert np.all(averse.occupied >= mean.occupied)
    assert averse.occupied.sum() > mean.occupied.sum()


def test_clearance_and_cells_agree(half_seen_room):
    arena = arena_from_map(half_seen_room)
    centres = arena.origin + arena.resolution * np.argwhere(np.ones_like(arena.occupied))
    clearance = arena.clearance.at(centres).reshape(arena.occupied.shape)
    inside = clearance[1:-1, 1:-1]
    assert np.all(inside[arena.occupied[1:-1, 1:-1]] < arena.resolution)
    assert np.all(inside[~arena.occupied[1:-1, 1:-1]] > -0.5 * VOXEL)


def test_bounds_keep_the_grid(half_seen_room):
    a, b = (arena_from_map(half_seen_room, u, bounds=BOUNDS) for u in ("mean", "averse"))
    assert a.occupied.shape == b.occupied.shape == (64, 47)
    assert np.allclose(a.origin, BOUNDS[0], atol=0.5 * a.resolution)
    assert np.array_equal(a.origin, b.origin)


def test_arena_of_cells():
    occupied = np.zeros((10, 8), bool)
    occupied[5, :] = True
    arena = Arena.from_occupied(occupied, np.array([1.0, 2.0]), 0.1)
    assert arena.clearance.at(np.array([1.2, 2.3])) == pytest.approx(0.25)


@pytest.mark.parametrize(
    "call",
    [
        lambda m: arena_from_map(m, "hopeful"),
        lambda m: arena_from_map(m, resolution=0.0),
        lambda m: arena_from_map(m, z_min=0.3, z_max=0.2),
        lambda m: arena_from_map(m, bounds=np.array([[5.0, 5.0], [6.0, 6.0]])),
        lambda m: arena_from_map(m, z_min=5.0, z_max=6.0),
        lambda m: Arena.from_occupied(np.zeros((1, 5), bool), np.zeros(2), 0.1),
        lambda m: Arena.from_occupied(np.zeros((5, 5), bool), np.zeros(2), -0.1),
    ],
)
def test_bad_input_is_named(half_seen_room, call):
    with pytest.raises(InputError):
        call(half_seen_room)
