"""Test geodesics against closed forms, an exhaustive visibility graph, a fine grid, and the axioms of a metric."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import shapely
from hypothesis import given, reject, settings
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from skimage.graph import MCP_Geometric

from tests.helpers.box_rooms import free_space, layouts, random_points, seeds
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.errors import InputError


def space_or_reject(obstacles: list, radius: float) -> FreeSpace:
    try:
        return free_space(obstacles, radius)
    except InputError:
        reject()


def exhaustive(region: shapely.Geometry, ends: np.ndarray) -> np.ndarray:
    """Return shortest lengths between ``ends`` over all visible pairs of border vertices and ends, without a filter."""
    nodes = np.concatenate([ends, shapely.get_coordinates(region)])
    i, j = np.triu_indices(len(nodes), 1)
    shapely.prepare(region)
    sees = shapely.covers(region, shapely.linestrings(np.stack([nodes[i], nodes[j]], axis=1)))
    i, j = i[sees], j[sees]
    weights = np.maximum(np.linalg.norm(nodes[i] - nodes[j], axis=1), 1e-12)
    graph = csr_array((weights, (i, j)), shape=(len(nodes), len(nodes)))
    return dijkstra(graph, directed=False, indices=np.arange(len(ends)))[:, : len(ends)]


def test_empty_room_is_euclidean() -> None:
    geodesics = Geodesics(free_space([], 0.1))
    start, goal = np.array([0.5, 0.5]), np.array([4.5, 3.5])
    assert geodesics.length(start, goal) == pytest.approx(5.0, abs=1e-12)
    assert geodesics.length(start, goal, 0.4) == pytest.approx(4.6, abs=1e-12)
    np.testing.assert_allclose(geodesics.path(start, goal, 0.4), [start, goal - 0.4 * np.array([0.8, 0.6])])
    assert geodesics.length(start, start + 0.3, 0.5) == 0.0
    np.testing.assert_array_equal(geodesics.path(start, start + 0.3, 0.5), [start])


def test_around_one_corner_by_hand() -> None:
    """The path of a point is two diagonals; that of a disc has two tangents, two arcs and the top between them."""
    box = shapely.box(2.0, -1.0, 3.0, 2.0)
    start, goal = np.array([1.0, 1.0]), np.array([4.0, 1.0])
    point = Geodesics(free_space([box], 0.0))
    assert point.length(start, goal) == pytest.approx(2 * math.sqrt(2.0) + 1.0, abs=1e-4)
    radius = 0.2
    # From (1, 1) to the circle around (2, 2): |d| = sqrt 2, tangent sqrt(2 - r^2), the arc turns from that tangent to
    # the box's top: the tangent's direction is 45 degrees + asin(r / sqrt 2).
    tangent = math.sqrt(2.0 - radius**2)
    turn = math.pi / 4 + math.asin(radius / math.sqrt(2.0))
    exact = 2 * (tangent + radius * turn) + 1.0
    disc = Geodesics(free_space([box], radius))
    assert exact <= disc.length(start, goal) <= exact + 0.01 * radius * 4


def test_goal_disc_partly_in_an_obstacle_by_hand() -> None:
    """The disc of a goal inside a wall is entered at the end of its free arc, beyond the wall."""
    box = shapely.box(2.0, -1.0, 3.0, 2.0)
    geodesics = Geodesics(free_space([box], 0.0))
    start, goal, radius = np.array([1.0, 1.5]), np.array([2.9, 1.0]), 0.5
    end = 1.0 + math.sqrt(radius**2 - 0.1**2)  # where the circle leaves the wall's right face x = 3
    by_hand = math.hypot(1.0, 0.5) + 1.0 + (2.0 - end)
    assert geodesics.length(start, goal, radius) == pytest.approx(by_hand, abs=1e-4)
    assert geodesics.length(start, goal) == math.inf
    # A thin wall: the disc's near side counts, though the goal is on the far side.
    thin = Geodesics(free_space([shapely.box(2.0, -1.0, 2.1, 3.0)], 0.1))
    assert thin.length(np.array([1.0, 1.5]), np.array([2.3, 1.5]), 0.5) == pytest.approx(0.8, abs=1e-9)
    assert thin.length(np.array([1.0, 1.5]), np.array([2.3, 1.5]), 0.35) > 2.0


def test_without_a_path_the_distance_is_infinite() -> None:
    geodesics = Geodesics(free_space([shapely.box(2.0, -1.0, 2.2, 5.0)], 0.1))
    left, right, wall = np.array([1.0, 1.0]), np.array([4.0, 1.0]), np.array([2.1, 1.0])
    assert geodesics.length(left, right) == math.inf and geodesics.path(left, right).shape == (0, 2)
    assert geodesics.length(wall, right) == math.inf and geodesics.length(left, wall) == math.inf
    lengths = geodesics.matrix(np.array([left, right, wall, left + 0.5]))
    assert np.array_equal(np.isfinite(lengths), np.array([[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 1]]))


@pytest.mark.parametrize("radius", [0.0, 0.1])
def test_straight_along_collinear_corners(radius: float) -> None:
    """Boxes whose corners lie on one line must not block the path along that line."""
    boxes = [shapely.box(x, 0.5, x + 0.3, 1.7) for x in (0.9, 1.7, 2.9, 3.3)]
    geodesics = Geodesics(free_space(boxes, radius))
    for y in (1.7 + radius * 1.01 + 1e-4, 1.7 + radius):  # just above the line, and a hair below it
        length = geodesics.length(np.array([0.2, y]), np.array([4.8, y]))
        assert length == pytest.approx(4.6, abs=2e-3)


@given(obstacles=layouts, radius=st.sampled_from([0.0, 0.1]), seed=seeds)
def test_agrees_with_exhaustive_visibility_graph(obstacles: list, radius: float, seed: int) -> None:
    space = space_or_reject(obstacles, radius)
    ends = random_points(space, seed, 4)
    geodesics, expected = Geodesics(space), exhaustive(space.region, ends)
    np.testing.assert_allclose([[geodesics.length(a, b) for b in ends] for a in ends], expected, atol=1e-6)
    np.testing.assert_allclose(geodesics.matrix(ends), expected, atol=1e-6)


@settings(max_examples=10)
@given(obstacles=layouts, seed=seeds)
def test_lies_between_finely_rounded_robots(obstacles: list, seed: int) -> None:
    """The length lies between those of the exact disc and of one that is 1 mm wider (1 % of 0.1 m)."""
    space = space_or_reject(obstacles, 0.1)
    ends = random_points(space, seed, 2)
    solid = shapely.union_all(obstacles) if obstacles else shapely.Polygon()
    room = shapely.box(0.0, 0.0, 5.0, 4.0)
    exact, wider = (room.buffer(-r) - solid.buffer(r, quad_segs=12) for r in (0.1, 0.102))
    found = Geodesics(space).length(ends[0], ends[1])
    assert found >= exhaustive(exact, ends)[0, 1] - 1e-4
    assert found <= exhaustive(wider, ends)[0, 1] + 1e-4 or not np.all(shapely.intersects_xy(wider, ends))


@pytest.mark.slow
def test_within_one_percent_of_finely_rounded_corners() -> None:
    """The error stays within its bound in a room full of boxes at generic places."""
    rng = np.random.default_rng(3)
    boxes = [shapely.box(x, y, x + w, y + 0.3) for x, y, w in rng.uniform((0, 0, 0.1), (4.5, 3.7, 0.8), (14, 3))]
    space = free_space(boxes, 0.1)
    ends = random_points(space, 0, 12)
    fine = shapely.box(0.1, 0.1, 4.9, 3.9) - shapely.union_all(boxes).buffer(0.1, quad_segs=16)
    expected, found = exhaustive(fine, ends), Geodesics(space).matrix(ends)
    assert np.max(expected - np.linalg.norm(ends[:, None] - ends, axis=2)) > 0.25  # there are corners to go around
    assert np.all(found >= expected - 1e-4) and np.all(found <= 1.01 * expected)


@given(obstacles=layouts, seed=seeds, goal_radius=st.sampled_from([0.2, 0.4]))
def test_success_region_against_dense_samples(obstacles: list, seed: int, goal_radius: float) -> None:
    """No free point of the circle is nearer than the end of the path."""
    space = space_or_reject(obstacles, 0.1)
    start, goal = random_points(space, seed, 2)
    geodesics = Geodesics(space)
    found = geodesics.length(start, goal, goal_radius)
    if np.linalg.norm(start - goal) <= goal_radius:
        assert found == 0.0
        return
    angle = np.linspace(0.0, 2 * np.pi, 120, endpoint=False)
    ring = goal + goal_radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring = ring[space.contains(ring)]
    assert found <= geodesics.matrix(np.concatenate([start[None], ring]))[0, 1:].min(initial=math.inf) + 1e-9
    end = geodesics.path(start, goal, goal_radius)[-1]
    assert np.linalg.norm(end - goal) <= goal_radius + 1e-9 and space.contains(end)


@given(obstacles=layouts, seed=seeds)
def test_metric_axioms(obstacles: list, seed: int) -> None:
    space = space_or_reject(obstacles, 0.1)
    points = random_points(space, seed, 5)
    geodesics = Geodesics(space)
    lengths = np.array([[geodesics.length(a, b) for b in points] for a in points])
    assert np.all(np.isfinite(lengths))
    np.testing.assert_allclose(lengths, lengths.T, atol=1e-9)
    assert np.all(np.diag(lengths) == 0.0)
    assert np.all(lengths >= np.linalg.norm(points[:, None] - points[None], axis=2) - 1e-12)
    assert np.all(lengths <= (lengths[:, :, None] + lengths[None]).min(axis=1) + 1e-9)
    np.testing.assert_allclose(lengths, geodesics.matrix(points), atol=1e-9)
    # A larger success region is never further away, and at most its radius nearer.
    for radius in (0.2, 0.4):
        region = geodesics.length(points[0], points[1], radius)
        assert lengths[0, 1] - region >= -1e-12
        assert region >= np.linalg.norm(points[0] - points[1]) - radius - 1e-9


@given(obstacles=layouts, seed=seeds, goal_radius=st.sampled_from([0.0, 0.3]))
def test_path_is_free_and_as_long_as_claimed(obstacles: list, seed: int, goal_radius: float) -> None:
    space = space_or_reject(obstacles, 0.1)
    start, goal = random_points(space, seed, 2)
    geodesics = Geodesics(space)
    path, length = geodesics.path(start, goal, goal_radius), geodesics.length(start, goal, goal_radius)
    assert np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)) == pytest.approx(length, abs=1e-9)
    assert np.array_equal(path[0], start)
    if len(path) > 1:
        assert space.region.covers(shapely.LineString(path))


@settings(max_examples=8)
@given(obstacles=layouts, seed=seeds)
def test_not_longer_than_on_a_fine_grid(obstacles: list, seed: int) -> None:
    """The geodesic is never longer than a path over free cells."""
    space = space_or_reject(obstacles, 0.1)
    cell = 0.02
    x, y = np.meshgrid(np.arange(0.0, 5.0, cell), np.arange(0.0, 4.0, cell), indexing="ij")
    free = space.contains(np.stack([x, y], axis=-1))
    cost = np.where(free, 1.0, np.inf)
    rng = np.random.default_rng(seed)
    start, goal = rng.choice(np.argwhere(free), 2)
    grid = MCP_Geometric(cost).find_costs([tuple(start)])[0][tuple(goal)] * cell
    found = Geodesics(space).length(start * cell, goal * cell)
    # Diagonal steps cut the corners of obstacles, by less than a cell a corner.
    assert found <= grid + 4 * cell
