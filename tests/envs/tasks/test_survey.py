"""Test surveys: they see every free place, visit every room, do not collide, and are nearly as short as possible."""

import itertools

import hypothesis.strategies as st
import numpy as np
import pytest
import shapely
from hypothesis import given, settings

from tests.helpers.box_rooms import furniture, seeds, two_rooms
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.tasks.survey import Waypoint, short_tour, survey_route
from vssm_gym.errors import InputError

ROBOT = HolonomicRobot()
pieces = st.lists(
    st.tuples(st.floats(0.5, 5.5), st.floats(0.5, 3.5), st.floats(0.2, 1.2), st.floats(0.2, 1.2), st.floats(0.0, 3.0)),
    max_size=5,
)


def positions(route: list[Waypoint]) -> np.ndarray:
    return np.array([(w.x, w.y) for w in route])


def viewpoints(route: list[Waypoint]) -> np.ndarray:
    return np.array([(w.x, w.y) for w in route if w.turn_around])


def unseen(apartment: Apartment, route: list[Waypoint], space: FreeSpace, reach: float, n: int) -> np.ndarray:
    """Return random free places that no viewpoint sees within its range past the obstacles."""
    places = space.sample(np.random.default_rng(0), n)
    views = viewpoints(route)
    solid = [
        footprint(b)
        for b in apartment.boxes()
        if b.center[2] - b.size[2] / 2 < 0.5 and b.center[2] + b.size[2] / 2 > 0.01
    ]
    blocking = shapely.union_all(solid)
    shapely.prepare(blocking)
    lines = shapely.linestrings(np.stack(np.broadcast_arrays(places[:, None], views[None]), axis=2))
    sees = ~shapely.intersects(blocking, lines) & (np.linalg.norm(places[:, None] - views, axis=2) <= reach)
    return places[~sees.any(axis=1)]


def check(apartment: Apartment, seed: int = 0) -> None:
    space = FreeSpace.from_apartment(apartment, ROBOT.radius, ROBOT.height)
    route = survey_route(apartment, ROBOT, seed)
    assert route[0].turn_around and route[-1].turn_around
    if len(route) > 1:
        assert space.region.covers(shapely.LineString(positions(route)))
    views = viewpoints(route)
    for name, room in space.rooms.items():
        visited = shapely.contains_xy(room, views).any()
        assert visited or name in space.cut_off_rooms()
    # What must be seen is a grid of 0.2 m: between its points a sliver behind a corner may be missed.
    assert len(unseen(apartment, route, space, 1.2 + 0.15, 1000)) <= 20


@settings(max_examples=8)
@given(boxes=pieces, seed=seeds)
def test_sees_everything_and_collides_with_nothing(boxes: list, seed: int) -> None:
    furnished = tuple(
        furniture(f"piece {i}", (x, y, 0.3), (w, d, 0.6), yaw) for i, (x, y, w, d, yaw) in enumerate(boxes)
    )
    check(two_rooms(pieces=furnished), seed)


@pytest.mark.parametrize("gap", [0.05, 0.025, 0.01, 0.003])
def test_space_behind_a_narrow_passage_is_seen(gap: float) -> None:
    """The door, 0.9 m wide, left open by the robot's diameter and ``gap``: the clearance that is kept goes by it."""
    width = 2.0 * ROBOT.radius + gap
    block = furniture("block", (3.0, 1.5 + width + 0.5, 0.3), (0.6, 1.0, 0.6))
    apartment = two_rooms(pieces=(block,))
    space = FreeSpace.from_apartment(apartment, ROBOT.radius, ROBOT.height)
    assert space.cut_off_rooms() == []
    check(apartment)


@settings(max_examples=8)
@given(x=st.floats(2.6, 3.4), y=st.floats(1.3, 2.6), w=st.floats(0.2, 1.2), d=st.floats(0.2, 1.2), yaw=st.floats(0, 3))
def test_sees_past_an_obstacle_in_the_door(x: float, y: float, w: float, d: float, yaw: float) -> None:
    check(two_rooms(pieces=(furniture("piece", (x, y, 0.3), (w, d, 0.6), yaw),)))


def test_built_in_apartment() -> None:
    check(load_scene("oak"))


def test_closed_door() -> None:
    """The room behind it is left out; the survey of the other room is complete."""
    check(two_rooms(openness=0.0, leaves=1))


def test_keeps_clear_where_there_is_room() -> None:
    apartment = two_rooms(pieces=(furniture("sofa", (1.2, 2.0, 0.3), (0.8, 1.6, 0.6)),))
    space = FreeSpace.from_apartment(apartment, ROBOT.radius, ROBOT.height)
    line = shapely.segmentize(shapely.LineString(positions(survey_route(apartment, ROBOT))), 0.02)
    assert space.distance_to_obstacle(shapely.get_coordinates(line)).min() >= ROBOT.radius + 0.2 - 0.02


def test_repeats_with_its_seed() -> None:
    apartment = two_rooms()
    assert survey_route(apartment, ROBOT, 3) == survey_route(apartment, ROBOT, 3)
    assert survey_route(apartment, ROBOT, 3) != survey_route(apartment, ROBOT, 4)


def test_fewer_viewpoints_with_more_reach() -> None:
    near, far = (survey_route(two_rooms(), ROBOT, reach=reach) for reach in (0.8, 2.0))
    assert sum(w.turn_around for w in far) < sum(w.turn_around for w in near)


@given(seed=seeds, n=st.integers(1, 7))
def test_tour_is_short(seed: int, n: int) -> None:
    """Every place is visited once, and the tour is within a tenth of the shortest order."""
    places = np.random.default_rng(seed).uniform(0.0, 1.0, (n, 2))
    lengths = np.linalg.norm(places[:, None] - places, axis=2)
    tour = short_tour(lengths)
    assert sorted(tour) == list(range(n))
    orders = np.array(list(itertools.permutations(range(n))))
    best = lengths[orders[:, :-1], orders[:, 1:]].sum(axis=1).min()
    assert lengths[tour[:-1], tour[1:]].sum() <= 1.1 * best + 1e-12


def test_no_room_for_the_robot() -> None:
    with pytest.raises(InputError, match="no position is free"):
        survey_route(two_rooms(), HolonomicRobot(body_length=5.0))
