"""Test the choice of views that the map does not show: they come one after the other, and end."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.agents.shared.searching.test_frontier_goals import room
from vssm_gym.agents.shared.searching.unseen_views import UnseenViews, UnseenViewsConfig
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.exploration.candidates import Roadmap

CONFIG, CAMERA = UnseenViewsConfig(), Camera.from_hfov(64, 48, math.radians(90.0))
WINDOW = 0.25 * math.pi - CONFIG.margin  # rad to each side of a heading
HERE, COLUMNS = np.array([2.0, 2.0, 0.0]), 120
PLACES = np.array([[2.0, 2.0], [1.0, 1.0], [3.0, 3.0]])
ROADMAP = Roadmap.of(room(), HERE[:2], 0.1)


def shown(unseen: dict[int, tuple[float, float]]) -> np.ndarray:
    """Return shares: 1, but for a range of headings (rad) at some places."""
    shares, headings = np.ones((len(PLACES), COLUMNS)), 2.0 * math.pi * np.arange(COLUMNS) / COLUMNS
    for place, (first, last) in unseen.items():
        shares[place, (headings >= first) & (headings <= last)] = 0.2
    return shares


def test_the_robot_looks_into_the_middle_of_what_is_unseen():
    views = UnseenViews(CONFIG, CAMERA)
    place = views.choose(PLACES, shown({2: (1.0, 2.0)}), ROADMAP, HERE)
    assert place is not None
    np.testing.assert_allclose(place, PLACES[2])
    assert views.chosen is not None
    assert abs(float(wrap_angle(views.chosen[2] - 1.5))) < WINDOW


def test_a_view_that_was_looked_at_is_not_chosen_again():
    views, shares, seen = UnseenViews(CONFIG, CAMERA), shown({0: (1.0, 2.0), 1: (3.0, 4.0)}), []
    while (place := views.choose(PLACES, shares, ROADMAP, HERE)) is not None:
        seen.append(place.tolist())
        views.close()
        assert len(seen) < 10
    assert seen == [[2.0, 2.0], [1.0, 1.0]]  # the nearer one first


@pytest.mark.parametrize("unseen", [{}, {0: (1.0, 1.2)}])
def test_a_map_that_shows_all_but_gaps_has_no_unseen_view(unseen):
    assert UnseenViews(CONFIG, CAMERA).choose(PLACES, shown(unseen), ROADMAP, HERE) is None


def test_of_two_headings_that_show_as_much_the_nearer_one_is_looked_at():
    """Both turns count, to where the robot drives and to where it looks: it arrives at (3, 3) with 45 degrees."""
    for first, last in ((1.2, 2.0), (4.9, 5.7)):
        shares = np.minimum(shown({2: (first, last)}), shown({2: (2.6, 3.4)}))
        views = UnseenViews(CONFIG, CAMERA)
        views.choose(PLACES, shares, ROADMAP, HERE)
        assert views.chosen is not None
        assert abs(float(wrap_angle(views.chosen[2] - 0.5 * (first + last)))) < WINDOW


def test_a_view_is_seen_once_the_map_shows_it_from_elsewhere():
    views, unseen = UnseenViews(CONFIG, CAMERA), shown({2: (1.0, 2.0)})
    assert not views.is_seen(PLACES, unseen)  # none is chosen
    views.choose(PLACES, unseen, ROADMAP, HERE)
    assert not views.is_seen(PLACES, unseen)
    assert not views.is_seen(np.empty((0, 2)), np.empty((0, COLUMNS)))
    assert not views.is_seen(PLACES[:2], shown({})[:2])  # the place is not among those that are compared
    assert views.is_seen(PLACES, shown({2: (1.0, 1.3)}))


def test_places_out_of_reach_are_not_chosen():
    cut = replace(ROADMAP, distance=np.full_like(ROADMAP.distance, np.inf))
    assert UnseenViews(CONFIG, CAMERA).choose(PLACES, shown({0: (1.0, 2.0)}), cut, HERE) is None
    assert UnseenViews(CONFIG, CAMERA).choose(np.empty((0, 2)), np.empty((0, COLUMNS)), ROADMAP, HERE) is None
