"""Test free space against its definition: a disc at a free position never collides, and little is missing."""

import numpy as np
import pytest
import shapely
from hypothesis import given, reject
from hypothesis import strategies as st

from tests.helpers.box_rooms import ROOM, free_space, furniture, layouts, seeds, two_rooms
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.errors import InputError

RADIUS = 0.1


def true_clearance(obstacles: list[shapely.Polygon], points: np.ndarray) -> np.ndarray:
    """Return the distance to the nearest obstacle or room border, from the definition."""
    solid = shapely.union_all([*obstacles, ROOM.exterior])
    return shapely.distance(solid, shapely.points(points)) * shapely.contains_xy(ROOM, points)


@given(obstacles=layouts, radius=st.sampled_from([0.05, 0.1, 0.2]), seed=seeds)
def test_a_free_disc_collides_with_nothing(obstacles: list, radius: float, seed: int) -> None:
    try:
        space = free_space(obstacles, radius)
    except InputError:
        reject()
    points = np.random.default_rng(seed).uniform(0.0, (5.0, 4.0), (2000, 2))
    border = shapely.get_coordinates(shapely.segmentize(space.region, 0.02))
    free, clearance = space.contains(points), true_clearance(obstacles, points)
    assert np.all(true_clearance(obstacles, border) >= radius - 1e-9)
    assert np.all(clearance[free] >= radius)
    # Nothing further from all obstacles than the arc error is missing, save pockets too small to stand in.
    missing = points[~free & (clearance > radius * 1.009 + 1e-4)]
    assert len(missing) <= 2
    np.testing.assert_allclose(space.distance_to_obstacle(points), clearance, atol=1e-9)


@given(obstacles=layouts, seed=seeds)
def test_sampling(obstacles: list, seed: int) -> None:
    """Samples are free, keep the margin, repeat with the seed, and extend one another."""
    try:
        space = free_space(obstacles, RADIUS)
        first = space.sample(np.random.default_rng(seed), 5, margin=0.02)
    except InputError:
        reject()
    more = space.sample(np.random.default_rng(seed), 40, margin=0.02)
    np.testing.assert_array_equal(first, more[:5])
    assert space.contains(more).all()
    assert np.all(shapely.distance(space.region.boundary, shapely.points(more)) >= 0.02 - 1e-4)


def test_samples_are_uniform() -> None:
    """Chi-square of counts in an 8 x 6 grid of an empty room, 99.99 % quantile for 47 degrees of freedom."""
    points = free_space([], 0.0).sample(np.random.default_rng(0), 9600)
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=(8, 6), range=((0, 5), (0, 4)))
    assert np.sum((counts - 200.0) ** 2 / 200.0) < 93.2


def test_two_rooms_by_hand() -> None:
    """The west room of 3 x 4 m loses half a wall on each side; the doorway joins the rooms, outer walls are closed."""
    space = FreeSpace.from_apartment(two_rooms(), RADIUS, 0.5)
    assert len(space.region.geoms) == 1 and space.cut_off_rooms() == []
    assert space.notice([]) == ""
    assert space.notice(["Rooms may be cut off."]).endswith("; checked: a robot 0.2 m across reaches every room")
    space.check_connected()
    west, doorway = (3.0 - 0.3) * (4.0 - 0.3), 0.3 * (0.9 - 0.2)
    rounded = 4 * (RADIUS**2 - np.pi * RADIUS**2 / 4)  # the door frame's four corners
    assert space.region.area == pytest.approx(2 * west + doorway + rounded, abs=0.03)
    assert space.contains(np.array([[3.0, 1.61], [3.0, 2.29]])).all()
    assert not space.contains(np.array([[3.0, 1.59], [3.0, 2.31], [0.14, 2.0], [-1.0, 2.0]])).any()
    assert space.distance_to_obstacle(np.array([1.5, 2.0])) == pytest.approx(1.45)


def test_closed_door_cuts_a_room_off() -> None:
    space = FreeSpace.from_apartment(two_rooms(openness=0.0, leaves=1), RADIUS, 0.5)
    assert len(space.region.geoms) == 2 and len(space.cut_off_rooms()) == 1
    assert space.notice([]).startswith(f"cut off from the rest: {space.cut_off_rooms()[0]};")
    assert space.notice(["A sofa floats."]).startswith("A sofa floats; cut off")
    with pytest.raises(InputError, match=f"two_rooms: rooms: .*cut off: {space.cut_off_rooms()[0]}"):
        space.check_connected()
    # The caller may continue with the largest component.
    assert np.unique(space.sample(np.random.default_rng(0), 200)[:, 0] > 3.0).size == 1


def test_only_obstacles_at_the_robots_height_count() -> None:
    spot = np.array([1.5, 2.0])
    for name, z, height, free in (
        ("rug", 0.004, 0.008, True),
        ("sill", 0.0, 0.03, False),
        ("shelf above", 0.81, 0.6, True),
        ("table top", 0.5, 0.04, False),
    ):
        space = FreeSpace.from_apartment(
            two_rooms(pieces=(furniture(name, (1.5, 2.0, z), (0.6, 0.4, height), yaw=0.3),)), RADIUS, 0.5
        )
        assert bool(space.contains(spot)) is free, name
        assert space.obstacles_at(spot) == ([] if free else [name])


def test_turned_furniture_stands_where_its_box_does() -> None:
    yaw = 0.7
    piece = furniture("sofa", (1.5, 2.0, 0.3), (1.2, 0.4, 0.6), yaw=yaw)
    space = FreeSpace.from_apartment(two_rooms(pieces=(piece,)), RADIUS, 0.5)
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    for direction, half in ((along, 0.6), (across, 0.2)):
        for sign in (1.0, -1.0):
            assert not space.contains([1.5, 2.0] + sign * direction * (half + RADIUS - 0.001))
            assert space.contains([1.5, 2.0] + sign * direction * (half + RADIUS + 0.001))


def test_no_room_for_the_robot() -> None:
    with pytest.raises(InputError, match="no position is free"):
        free_space([shapely.box(0.1, 0.1, 4.9, 3.9)], RADIUS)
    with pytest.raises(InputError, match="margin"):
        free_space([], RADIUS).sample(np.random.default_rng(0), 1, margin=3.0)


def test_nearest_is_free_and_near() -> None:
    space = free_space([shapely.box(2.0, 1.0, 3.0, 2.0)], RADIUS)
    for outside in ([2.5, 1.05], [1.905, 1.5], [-1.0, 2.0], [2.95, 1.5]):
        inside = space.nearest(outside)
        assert space.contains(inside)
        exact = shapely.distance(space.region, shapely.Point(outside))
        assert exact - 1e-12 <= np.linalg.norm(inside - outside) <= exact + 3e-4
    np.testing.assert_array_equal(space.nearest([1.0, 1.0]), [1.0, 1.0])


@given(obstacles=layouts)
def test_a_wider_robot_has_less_room(obstacles: list) -> None:
    try:
        space = free_space(obstacles, RADIUS)
        wide = space.widened(0.1)
    except InputError:
        reject()
    assert space.region.buffer(1e-4).covers(wide.region)
    assert wide.radius == pytest.approx(0.2)
