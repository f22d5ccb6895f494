"""Test what a car would meet unseen on a route, and the poses from which it sees it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.agents.shared.car.looking import EDGE, SEEN_MARGIN, SIGHT_TO, Sight, between
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car.footprint import footprint_cells

CAR, CELL, N = Car(), 0.04, 100
HALF_ANGLE = np.pi / 4  # rad, of the camera
CORNER = np.array([-2.0, -2.0])


def grid(*boxes: tuple[float, float, float, float]) -> np.ndarray:
    """Return the cells of boxes ``(x0, x1, y0, y1)``, m."""
    x, y = np.meshgrid(*(CORNER[a] + CELL * np.arange(N) for a in (0, 1)), indexing="ij")
    cells = np.zeros((N, N), bool)
    for x0, x1, y0, y1 in boxes:
        cells |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    return cells


def sight(unseen: np.ndarray, *boxes: tuple[float, float, float, float], half_angle: float = HALF_ANGLE) -> Sight:
    return Sight(grid(*boxes), unseen, CORNER, CELL, CAR, half_angle)


def route(steering: float, ahead: float, motions: int = 8) -> np.ndarray:
    lengths = 0.13 * ahead * np.arange(motions)
    return poses_after(0.0, lengths, turn_of(lengths, steering, CAR.wheelbase), np.zeros(1), np.zeros(1))


BEYOND = grid((0.6, 2.0, -2.0, 2.0))  # all that is farther ahead
BESIDE = grid((-2.0, 2.0, -2.0, -0.2))  # on the right
BEHIND = grid((-2.0, -0.2, -2.0, 2.0))


@pytest.mark.parametrize(
    ("unseen", "steering", "ahead", "blind"),
    [
        (BEYOND, 0.0, 1.0, False),  # it comes into view
        (BEYOND, 0.15, 1.0, False),
        (BESIDE, 0.0, 1.0, False),  # it is not driven onto
        (BESIDE, -CAR.max_steering, 1.0, True),  # the front's inner corner comes there first
        (BEHIND, 0.0, -1.0, True),
        (BEHIND, 0.0, 1.0, False),
    ],
)
def test_what_a_car_meets_unseen(unseen, steering, ahead, blind):
    path, view = route(steering, ahead), sight(unseen)
    patch = view.blind(path)
    assert (len(patch) > 0) == blind
    assert unseen[tuple(patch.T)].all()
    if blind:
        swept = np.concatenate([footprint_cells(CORNER, CELL, pose, CAR, SEEN_MARGIN) for pose in between(path)])
        assert set(map(tuple, patch)) <= set(map(tuple, swept))
        assert not view.seen(path[1:2], patch).all()
        first = view.blind(path, 1)
        assert 0 < len(first) < len(patch) and set(map(tuple, first)) <= set(map(tuple, patch))
    met = view.first_met(path)
    motions = [np.concatenate([view.unseen_under(pose) for pose in between(path[k - 1 : k + 1])]) for k in range(1, 8)]
    assert met == next((k for k, cells in enumerate(motions, 1) if len(cells)), None)
    if blind:
        assert met <= view.first_blind(path)


@pytest.mark.parametrize(
    ("unseen", "steering", "ahead", "forwards", "backwards"),
    [(BESIDE, -CAR.max_steering, 1.0, 1, 0), (BEHIND, 0.0, -1.0, 0, 1), (BEYOND, 0.0, 1.0, 0, 0)],
)
def test_the_risk_of_a_route_is_the_price_of_its_blind_motions(unseen, steering, ahead, forwards, backwards):
    path, view = route(steering, ahead), sight(unseen)
    blind = sum(
        not view.seen(between(path[: k + 1])[:-1], view.unseen_under(path[k])).all() for k in range(1, len(path))
    )
    assert view.risk(path, (6.0, 60.0)) == blind * (6.0 * forwards + 60.0 * backwards)
    assert (blind > 0) == (forwards + backwards > 0)


@pytest.mark.parametrize(("away", "blind"), [(0.02, True), (0.12, False)])
def test_what_the_actor_keeps_free_has_to_be_seen_too(away, blind):
    """A wall of unseen cells beside a straight drive backwards, at a distance from the footprint's side."""
    side = -0.5 * CAR.width - away
    path = route(0.0, -1.0)
    assert (len(sight(grid((-2.0, -0.2, -2.0, side))).blind(path)) > 0) == blind


def test_an_obstacle_before_it_hides_what_lies_beyond():
    cell = np.array([[75, 50]])  # 1 m ahead
    facing = np.array([[0.0, 0.0, 0.0]])
    assert sight(BEYOND).seen(facing, cell).all()
    assert not sight(BEYOND, (0.6, 0.7, -0.5, 0.5)).seen(facing, cell).any()
    assert not sight(BEYOND).seen(np.array([[0.0, 0.0, np.pi]]), cell).any()


@pytest.mark.parametrize(("half_angle", "shown"), [(np.pi / 4, True), (np.pi / 6, False)])
def test_what_a_view_shows_depends_on_the_camera(half_angle, shown):
    """A cell 35 degrees off, 1 m away."""
    off = np.radians(35.0)
    cell = np.round((np.array([np.cos(off) + CAR.camera_forward, np.sin(off)]) - CORNER) / CELL).astype(int)[None]
    assert sight(BEYOND, half_angle=half_angle).seen(np.zeros((1, 3)), cell).all() == shown


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
def test_viewpoints_see_the_patch_through_what_is_known(x, y):
    """From each of them it is ahead, within range, and nothing occupied or unseen lies between."""
    middle = np.round((np.array([x, y]) - CORNER) / CELL).astype(int)
    patch = middle + np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)
    unseen = grid((-2.0, -1.0, -2.0, 2.0))
    unseen[tuple(patch.T)] = True
    view = sight(unseen, (0.1, 0.2, -0.6, 0.6))
    shows = view.viewpoints(patch, 64)
    at = np.argwhere(shows)[:: max(1, np.count_nonzero(shows) // 50)]
    poses = np.column_stack([CORNER + CELL * at[:, :2], 2.0 * np.pi / 64 * at[:, 2]])
    for pose in poses:
        camera = pose[:2] + CAR.camera_forward * np.array([np.cos(pose[2]), np.sin(pose[2])])
        to = CORNER + CELL * middle - camera
        assert np.hypot(*to) <= SIGHT_TO + CELL
        assert abs(wrap_angle(np.arctan2(to[1], to[0]) - pose[2])) <= HALF_ANGLE - EDGE
        between = camera + np.linspace(0.0, 0.9, 40)[:, None] * to
        cells = np.round((between - CORNER) / CELL).astype(int)
        hidden = (grid((0.14, 0.16, -0.56, 0.56)) | grid((-2.0, -1.04, -2.0, 2.0)))[tuple(cells.T)]
        assert not (hidden & (np.abs(cells - middle).max(axis=1) > 2)).any()


def test_there_is_a_viewpoint_of_what_lies_beside_a_car():
    view = sight(BESIDE)
    patch = view.blind(route(-CAR.max_steering, 1.0))
    shows = view.viewpoints(patch, 64)
    assert shows.any() and not shows[50, 50, 0]  # not from where it stands
