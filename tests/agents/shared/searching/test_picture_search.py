"""Test the search of a growing map for a picture: it finds the pose, with bounded work, and nothing of nowhere."""

import numpy as np
import pytest
import shapely

from tests.agents.test_agents import CAMERA, FLOOR, TABLE, WALL, context, learned, observe
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.agents.shared.searching.picture_matches import Match, Matches
from vssm_gym.agents.shared.searching.picture_search import PictureSearch, PictureSearchConfig
from vssm_gym.inference.relocalisation.panoramas import Panoramas
from vssm_gym.maps.columns import BODY_HEIGHTS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.planning.floor_plan import FloorPlan

__all__ = ["learned"]  # the fixture

START, TAKEN = np.array([1.0, 1.0, 1.0]), np.array([4.3, 0.6, 2.5])
CONFIG = PictureSearchConfig()


def searched(m: VoxelMap, picture: np.ndarray, steps: int = 60) -> PictureSearch:
    """Return a search after some steps in a map that does not change."""
    search = PictureSearch(CONFIG, context(None, START), picture.astype(np.float32) / 255.0)
    plan = FloorPlan.of(m, *BODY_HEIGHTS)
    for _ in range(steps):
        search.step(m, plan)
    return search


@pytest.fixture(scope="module")
def found(learned) -> PictureSearch:
    return searched(learned, observe(TAKEN, TAKEN[:2], learned)["rgb"])


@pytest.mark.slow
def test_the_pose_of_a_picture_is_the_likeliest_match(found):
    best = found.matches.all[0]
    assert best.is_near(TAKEN, 0.1, 0.1)
    assert best.correlation > 0.9
    assert best.share > 0.9
    others = [one for one in found.matches.all[1:] if not one.is_near(TAKEN, 0.5, 0.4)]
    assert others
    assert max(one.correlation for one in others) < best.correlation - 0.1


@pytest.mark.slow
def test_matches_are_apart_and_the_likeliest_first(found):
    matches, config = found.matches.all, CONFIG.matches
    values = [one.log_prob for one in matches]
    assert values == sorted(values, reverse=True)
    assert len(values) <= config.kept
    for i, one in enumerate(matches):
        assert not any(one.is_near(other.planar, *config.apart) for other in matches[:i])


def test_what_the_camera_has_refuted_is_no_match_again():
    first, near, far = (Match(np.array([x, 0.0, 0.0]), 3.0 - x, 0.9, 0.9) for x in (0.0, 0.4, 2.0))
    matches = Matches()
    for one in (far, near, first):
        matches.add(one)
    assert matches.all == [first, near, far]
    assert matches.best(0.5, 0.8, 0.5) is first
    assert matches.best(0.5, 0.8, 0.5, than=near) is None  # nearby
    assert matches.best(0.5, 0.8, 0.5, than=far) is first
    assert matches.best(0.5, 0.8, 0.5, than=Match(far.planar, 2.5, 0.9, 0.9)) is None  # not likelier by enough
    matches.refute(first)
    assert matches.best(0.5, 0.8, 0.5) is far
    assert matches.best(1.0, 0.8, 0.5) is far  # of 1 nat a pixel, of which the map shows 0.9
    assert matches.best(1.2, 0.8, 0.5) is None
    assert matches.best(0.5, 0.95, 0.5) is None
    assert matches.best(0.5, 0.8, 0.95) is None


def test_refuted_matches_make_room_for_others():
    matches = Matches()
    look_alikes = [Match(np.array([2.0 * k, 0.0, 0.0]), 5.0, 0.9, 0.9) for k in range(CONFIG.matches.kept)]
    for one in look_alikes:
        matches.add(one)
        matches.refute(one)
        matches.add(one)
    true = Match(np.array([0.0, 5.0, 0.0]), 4.0, 0.9, 0.9)
    matches.add(true)
    assert matches.best(1.0, 0.5, 0.5) is true


def test_a_step_renders_few_panoramas_and_none_where_nothing_is_new(found, learned, monkeypatch):
    """After enough steps every free place has its panorama, and a map that stays asks for no work."""
    search, calls = searched(learned, np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), 1), []
    assert len(search.places) == CONFIG.panoramas
    assert len(found.places) > 10 * CONFIG.panoramas
    plan = FloorPlan.of(learned, *BODY_HEIGHTS)
    for _ in range(200):
        if found.is_done:
            break
        found.step(learned, plan)
    assert found.is_done
    monkeypatch.setattr("vssm_gym.agents.shared.searching.picture_search.Panoramas.of", lambda *a: calls.append(a))
    monkeypatch.setattr("vssm_gym.agents.shared.searching.picture_search.align_views", lambda *a: calls.append(a))
    for _ in range(CONFIG.every):
        found.step(learned, plan)
    assert not calls


def test_half_of_a_view_is_enough_to_be_found(learned):
    """The map shows half of what the picture does."""
    half = voxel_map(FLOOR, [(WALL, 0.0, 1.0), (TABLE, 0.0, 0.7)], observed=lambda x, y, z: (x > 2.6) & (y < 1.6))
    best = searched(half, observe(TAKEN, TAKEN[:2], learned)["rgb"], 20).matches.best(3.5, 0.6, 0.4)
    assert best is not None
    assert best.is_near(TAKEN, 0.1, 0.1)
    assert best.share < 0.6


@pytest.mark.slow
def test_places_from_which_most_is_unseen_are_rendered_first(monkeypatch):
    """One of two rooms is known, of the other only what is low, until all of it becomes known, too."""
    wall = [(shapely.box(2.45, 0.0, 2.55, 3.0), 0.0, 2.5)]
    low, whole = voxel_map(FLOOR, wall, observed=lambda x, y, z: (x < 2.5) | (z < 0.6)), voxel_map(FLOOR, wall)
    search, rendered, render = searched(low, np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)), [], Panoramas.of
    monkeypatch.setattr(
        "vssm_gym.agents.shared.searching.picture_search.Panoramas.of",
        lambda m, cylinder, places, *rest: rendered.append(places) or render(m, cylinder, places, *rest),
    )
    east, plan = int((search.places[:, 0] > 2.5).sum()), FloorPlan.of(whole, *BODY_HEIGHTS)
    assert 50 < east < len(search.places) - 50
    while sum(map(len, rendered)) < 0.9 * east:
        search.step(whole, plan)
    assert (np.concatenate(rendered)[:, 0] > 2.5).all()


def test_the_camera_agrees_with_the_picture_at_its_place_alone(found, learned):
    image = lambda planar: RGBD.from_camera(*(observe(planar, TAKEN[:2], learned)[key] for key in ("rgb", "depth")))
    near, elsewhere = TAKEN + np.array([0.1, -0.1, 0.1]), np.array([1.0, 1.5, 2.5])
    assert found.agrees(image(near), near, TAKEN)
    assert not found.agrees(image(elsewhere), TAKEN, TAKEN)


def test_nothing_matches_noise(learned):
    noise = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width, 3))
    assert max((one.correlation for one in searched(learned, noise, 20).matches.all), default=0.0) < 0.4


def test_shares_tell_what_of_a_view_is_in_the_map():
    """In a map of which one half was never observed, views into that half are unseen."""
    half = voxel_map(FLOOR, [(WALL, 0.0, 1.0)], observed=lambda x, y, z: x < 2.3)
    search = searched(half, np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    k = int(np.argmin(np.hypot(*(search.places - [1.8, 1.5]).T)))
    columns = search.shares.shape[1]
    assert search.shares[k, columns // 2] > 0.9  # west
    assert search.shares[k, columns // 2] > search.shares[k, 0] + 0.1
