"""Test rays and sliding discs in the plane against shapely, and against numbers computed by hand."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.affinity import rotate

from vssm_gym.envs.physics.planar import SKIN, clearance, rectangles, scan, slide
from vssm_gym.envs.scenes.scene import Material
from vssm_gym.envs.scenes.solids import SolidBox

RADIUS = 0.0125
FAR = 10.0  # m, beyond everything here
BLOCK = np.array([[0.5, 0.5, 1.0, 0.0, 0.1, 0.2]])  # x in [0.4, 0.6], y in [0.3, 0.7]

unit = st.floats(0.0, 1.0)
layouts = st.lists(
    st.tuples(
        unit, unit, st.sampled_from([0.0, 0.0, 0.5 * math.pi, 0.4, 2.2]), st.floats(0.002, 0.2), st.floats(0.002, 0.2)
    ),
    min_size=1,
    max_size=8,
).map(lambda rows: np.array([(x, y, math.cos(a), math.sin(a), hx, hy) for x, y, a, hx, hy in rows]))
poses = st.tuples(unit, unit, st.floats(-4.0, 4.0))
# Along the axes too: a ray in a wall's own line is where slabs divide by zero.
pushes = st.tuples(st.floats(0.0, 0.1), st.one_of(st.floats(-4.0, 4.0), st.sampled_from([0.0, 0.5 * math.pi, math.pi])))


def solid(rows: np.ndarray) -> shapely.Geometry:
    """Return the union of rectangles."""
    shapes = []
    for x, y, c, s, half_x, half_y in rows:
        box = shapely.box(x - half_x, y - half_y, x + half_x, y + half_y)
        shapes.append(rotate(box, math.atan2(s, c), origin=(x, y), use_radians=True))
    return shapely.union_all(shapes)


@given(layouts, poses, st.integers(1, 32))
def test_ranges_are_those_of_shapely(rows, pose, beams):
    world, eye = solid(rows), shapely.Point(pose[:2])
    thin = world.buffer(-1e-9)
    [found] = scan(np.array([pose]), rows, beams)
    for k, reading in enumerate(found):
        angle = pose[2] + 2.0 * math.pi * k / beams
        end = (pose[0] + FAR * math.cos(angle), pose[1] + FAR * math.sin(angle))
        ray = shapely.LineString([pose[:2], end])
        hit = ray.intersection(world)
        expected = math.inf if hit.is_empty else eye.distance(hit)
        if reading != pytest.approx(expected, abs=1e-9):
            # Only where it grazes a corner or runs along a face, which rounding decides: without such it is the same.
            end_of_reading = (pose[0] + reading * math.cos(angle), pose[1] + reading * math.sin(angle))
            assert thin.disjoint(shapely.LineString([pose[:2], end_of_reading] if reading < FAR else [pose[:2], end]))
            assert reading == math.inf or world.distance(shapely.Point(end_of_reading)) < 1e-9


def test_a_scan_by_hand():
    ahead, left, behind, right = scan(np.array([[0.2, 0.5, 0.0]]), BLOCK, 4)[0]
    assert (ahead, left, behind, right) == (pytest.approx(0.2), math.inf, math.inf, math.inf)
    quarter = scan(np.array([[0.2, 0.5, -0.5 * math.pi]]), BLOCK, 4)[0]
    assert quarter[1] == pytest.approx(0.2) and np.isinf(np.delete(quarter, 1)).all()  # beam 1 is to the left
    assert (scan(np.array([[0.5, 0.5, 0.3]]), BLOCK, 7) == 0.0).all()


def test_a_batch_of_scans_is_the_scans_one_by_one():
    rng = np.random.default_rng(0)
    many = rng.uniform(0.0, 1.0, (20, 3))
    np.testing.assert_array_equal(scan(many, BLOCK, 9), np.concatenate([scan(one[None], BLOCK, 9) for one in many]))


@given(layouts, unit, unit)
def test_clearance_is_the_distance_of_shapely(rows, x, y):
    assert clearance(x, y, rows) == pytest.approx(solid(rows).distance(shapely.Point(x, y)), abs=1e-12)


@given(layouts, unit, unit, st.lists(pushes, min_size=1, max_size=30))
def test_a_disc_stays_outside_and_moves_freely_where_nothing_is_near(rows, x, y, steps):
    world = solid(rows)
    if clearance(x, y, rows) < RADIUS + SKIN:
        return
    for length, angle in steps:
        dx, dy = length * math.cos(angle), length * math.sin(angle)
        swept = world.distance(shapely.LineString([(x, y), (x + dx, y + dy)])) - RADIUS - SKIN
        x_new, y_new, collided = slide(x, y, dx, dy, RADIUS, rows)
        if swept > 1e-9:
            assert not collided and math.hypot(x_new - x - dx, y_new - y - dy) <= 1e-12
        if swept < -1e-9:
            assert collided
        assert math.hypot(x_new - x, y_new - y) <= length + 1e-12  # a wall never pushes
        x, y = x_new, y_new
        assert clearance(x, y, rows) >= RADIUS


def test_sliding_by_hand():
    """Against the left face of the block the component along the face remains."""
    x, y, collided = slide(0.3, 0.5, 0.2, 0.1, RADIUS, BLOCK)
    assert collided and (x, y) == (pytest.approx(0.4 - RADIUS - SKIN, abs=1e-12), pytest.approx(0.6))
    x, y, collided = slide(x, y, 0.05, 0.0, RADIUS, BLOCK)
    assert collided and y == pytest.approx(0.6)
    x, y, collided = slide(x, y, -0.05, 0.0, RADIUS, BLOCK)
    assert not collided and x == pytest.approx(0.35 - RADIUS - SKIN)


@pytest.mark.parametrize("turned", [0.0, 0.7])
@pytest.mark.parametrize("east", [-1.0, 1.0])
@pytest.mark.parametrize("north", [-1.0, 1.0])
def test_a_corner_is_round_to_a_disc(turned, east, north):
    """Straight against a corner of the block the normal is the direction of the push, so that the disc stops."""
    c, s = math.cos(turned), math.sin(turned)
    block = np.array([[0.5, 0.5, c, s, 0.1, 0.2]])
    corner = np.array([0.5, 0.5]) + np.array([[c, -s], [s, c]]) @ (0.1 * east, 0.2 * north)
    out = np.array([[c, -s], [s, c]]) @ (0.8 * east, 0.6 * north)
    start = corner + 0.1 * out
    x, y, collided = slide(*start, *(-0.1 * out), RADIUS, block)
    assert collided
    np.testing.assert_allclose((x, y), corner + (RADIUS + SKIN) * out, atol=1e-9)


def test_a_wedge_stops_a_disc_which_can_leave_it():
    """Two walls meet at 60 degrees: pushed into the wedge the disc stops, pushed out it moves freely."""
    half = math.radians(30.0)
    rows = []
    for sign in (1.0, -1.0):  # thin walls from the origin along +-30 degrees
        c, s = math.cos(sign * half), math.sin(sign * half)
        rows.append((0.5 * c, 0.5 * s, c, s, 0.5, 0.001))
    wedge = np.array(rows)
    x, y = 0.5, 0.0
    for _ in range(20):
        x, y, collided = slide(x, y, -0.1, 0.003, RADIUS, wedge)
        assert clearance(x, y, wedge) >= RADIUS
    assert collided
    deepest = (RADIUS + SKIN + 0.001) / math.sin(half)
    assert (x, y) == (pytest.approx(deepest, abs=1e-3), pytest.approx(0.0, abs=1e-3))
    assert slide(x, y, 0.1, 0.0, RADIUS, wedge)[:2] == (pytest.approx(x + 0.1), pytest.approx(y))


def test_only_boxes_that_the_plane_cuts_are_in_it():
    def box(z: float, height: float) -> SolidBox:
        return SolidBox("box", "wall", (0.1, 0.2, z), (0.4, 0.2, height), 0.3, Material())

    cut = rectangles([box(0.05, 0.1), box(0.2, 0.1), box(-0.05, 0.1)], 0.05)
    np.testing.assert_allclose(cut, [[0.1, 0.2, math.cos(0.3), math.sin(0.3), 0.2, 0.1]])
    assert rectangles([], 0.05).shape == (0, 6)
