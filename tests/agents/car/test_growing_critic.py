"""Test the cost-to-go on a growing floor plan: warm equals cold, computed where it matters, compiled once."""

from dataclasses import replace

import numpy as np
import pytest

from vssm_gym.agents.shared.car.growing_critic import LOOKED, TOLERANCE, GrowingConfig, GrowingCritic
from vssm_gym.agents.shared.car.routes import descend, way_out
from vssm_gym.geometry.car import GOAL_RADIUS, Car
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.planning.value_iteration import ValueStatus, sweeps

CAR, CELL, HALF_ANGLE = Car(), 0.05, np.pi / 4
START, GOAL = np.array([0.6, 0.6, 0.0]), np.array([1.8, 1.6, 0.4])
CONFIG = GrowingConfig(sides=(56, 84), room=0.4, changed=30)
AWAY = np.array([-1.0, -1.0])  # m, of the plan's first cell


def plan(known: float, *boxes: tuple[float, float, float, float]) -> FloorPlan:
    """Return a plan of 5 x 5 m that is known up to ``x = known``, with boxes ``(x0, x1, y0, y1)``, m."""
    x, y = np.meshgrid(*(AWAY[a] + CELL * np.arange(100) for a in (0, 1)), indexing="ij")
    cells = np.where(x < known, FREE, UNKNOWN).astype(np.int8)
    for x0, x1, y0, y1 in boxes:
        cells[(x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (x < known)] = OCCUPIED
    occupancy = np.where(cells == OCCUPIED, CELL, np.where(cells == FREE, -CELL, -np.inf)).astype(np.float32)
    return FloorPlan(cells, occupancy, AWAY, CELL)


def critic_after(*plans: FloorPlan) -> GrowingCritic:
    critic = GrowingCritic(CAR, GOAL, HALF_ANGLE, CONFIG)
    for k, one in enumerate(plans):
        for _ in range(CONFIG.pause + 1 if k else 1):
            critic.update(one, START)
    return critic


BOX = (1.0, 1.3, 0.2, 1.1)
GROWTHS = [
    (plan(1.0), plan(1.6, BOX), plan(3.0, BOX)),  # what was unknown holds a box
    (plan(3.0, BOX), plan(3.0)),  # a box that was none
    (plan(0.9), plan(3.0)),
]


@pytest.mark.slow
@pytest.mark.parametrize("plans", GROWTHS)
def test_warm_started_values_equal_cold_ones(plans):
    warm, cold = critic_after(*plans), critic_after(plans[-1])
    assert warm.computed == len(plans) and cold.computed == 1
    never = cold.value.never
    ours, theirs = np.asarray(warm.value.values), np.asarray(cold.value.values)
    np.testing.assert_array_equal(ours == never, theirs == never)
    np.testing.assert_allclose(ours, theirs, atol=5.0 * TOLERANCE)


@pytest.mark.slow
def test_growth_compiles_nothing():
    critic_after(*GROWTHS[0])
    compiled = len(sweeps._iterate.signatures)
    critic_after(*GROWTHS[0])
    critic_after(*GROWTHS[1])
    assert len(sweeps._iterate.signatures) == compiled


def test_it_is_computed_again_where_that_matters_only():
    """An obstacle on the route matters at once; a few cells elsewhere never, many after the pause."""
    critic = critic_after(plan(3.0))
    route = descend(critic.value, START, CAR)
    assert np.hypot(*(route[-1, :2] - GOAL[:2])) < GOAL_RADIUS
    for _ in range(3 * CONFIG.pause):
        critic.update(plan(3.0, (-0.8, -0.7, 2.5, 2.6)), START)
    assert critic.computed == 1
    x, y = route[len(route) // 2, :2]
    critic.update(plan(3.0, (x - 0.06, x + 0.06, y - 0.06, y + 0.06)), START)
    assert critic.computed == 2
    for k in range(CONFIG.pause):
        assert critic.computed == 2, k
        critic.update(plan(3.0, (-0.1, 0.4, 1.9, 2.4)), START)
    assert critic.computed == 3


@pytest.mark.slow
def test_without_a_path_the_grid_grows_and_then_there_is_none():
    wall = (1.1, 1.2, -1.0, 2.6)  # beyond the first grid it ends
    critic = critic_after(plan(4.0, wall))
    assert critic.computed == 2 and critic.value is not None
    assert critic.value.values.shape[:2] == (84, 84)
    closed = critic_after(plan(4.0, (1.1, 1.2, -1.0, 4.0)))
    assert closed.value is None and closed.status is ValueStatus.UNREACHABLE


def test_to_forget_computes_it_again():
    critic = critic_after(plan(3.0))
    critic.forget()
    critic.update(plan(3.0), START)
    assert critic.computed == 2 and critic.value is not None


def seen(*boxes: tuple[float, float, float, float]) -> FloorPlan:
    """Return a plan in which only the boxes ``(x0, x1, y0, y1)``, m, were seen, and are free."""
    made = plan(-9.0)
    x, y = np.meshgrid(*(AWAY[a] + CELL * np.arange(100) for a in (0, 1)), indexing="ij")
    for x0, x1, y0, y1 in boxes:
        made.cells[(x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)] = FREE
    made.occupancy[made.cells == FREE] = -CELL
    return made


def test_unseen_space_counts_its_motions():
    critic = GrowingCritic(CAR, np.array([0.1, 0.6, np.pi]), HALF_ANGLE, CONFIG)
    critic.update(seen((0.8, 2.0, 0.2, 1.0)), np.array([1.2, 0.6, 0.0]))
    ahead, back = critic.value.counted(np.array([[-0.1, 0.6, 0.0]] * 2), np.array([1.0, -1.0]))
    assert (ahead, back) == CONFIG.unknown
    assert critic.value.counted(np.array([[1.3, 0.6, 0.0]]), np.array([1.0])) == 1.0


HALL = (0.9, 2.8, -0.4, 1.6)  # what a car at FACING knows; the target is behind it
FACING, BEHIND = np.array([1.2, 0.6, 0.0]), np.array([0.2, 0.6, np.pi])


def test_it_looks_before_it_drives_onto_what_it_has_not_seen():
    """Behind it nothing was seen: the actor is led to a pose that faces it, and then to the target."""
    critic = GrowingCritic(CAR, BEHIND, HALF_ANGLE, CONFIG)
    critic.update(seen(HALL), FACING)
    assert critic.looks and float(critic.aim.at(FACING)) > 0.0
    values = np.asarray(critic.aim.values)
    x, _, k = np.argwhere(values == 0.0).T
    assert len(x)
    facing = np.cos(2.0 * np.pi / values.shape[2] * k)
    xs = float(critic.aim.origin[0]) + CELL * x
    assert (facing[xs > 1.2] < 0.0).all()  # from ahead of where it stands it sees it only facing back
    critic.update(seen((-0.9, 2.8, -0.4, 1.6)), FACING)
    assert not critic.looks
    np.testing.assert_array_equal(critic.aim.values, critic.value.values)


def test_it_does_not_back_up_blindly_to_look_at_what_lies_beside_it():
    """It knows a cone ahead of it; to drive on there risks less than the way back to where it would see more."""
    x, y = np.meshgrid(*(AWAY[a] + CELL * np.arange(100) for a in (0, 1)), indexing="ij")
    ahead = (x > 1.2) & (np.abs(y - 0.6) < 0.18 + (x - 1.4)) | (x > 1.1) & (x < 1.55) & (np.abs(y - 0.6) < 0.2)
    cells = np.where(ahead & (x < 1.8), FREE, UNKNOWN).astype(np.int8)
    cone = FloorPlan(cells, np.where(cells == FREE, -CELL, -np.inf).astype(np.float32), AWAY, CELL)
    critic = GrowingCritic(CAR, np.array([0.6, 1.4, np.pi]), HALF_ANGLE, replace(CONFIG, unknown=(1.5, 20.0)))
    critic.update(cone, FACING)
    assert critic.aim is not None and not critic.looks
    first = descend(critic.aim, FACING, CAR)[1]
    assert first[0] > FACING[0]


def test_what_is_not_seen_from_where_it_should_be_is_looked_at_no_more():
    """The car stands at a pose from which the patch should be seen, and it stays unknown."""
    critic = GrowingCritic(CAR, BEHIND, HALF_ANGLE, CONFIG)
    critic.update(seen(HALL), FACING)
    patch, viewpoint = critic._patch, descend(critic._followed, FACING, CAR)[-1]
    for _ in range(LOOKED):
        critic.update(seen(HALL), viewpoint)
        assert critic.computed == 1
    critic.update(seen(HALL), viewpoint)
    assert critic.computed == 2 and critic._vain[tuple(patch.T)].all()
    assert not set(map(tuple, patch)) & set(map(tuple, critic._patch))


def test_what_it_keeps_off_is_what_is_occupied_or_unseen():
    critic = GrowingCritic(CAR, BEHIND, HALF_ANGLE, CONFIG)
    critic.update(seen(HALL), FACING)
    keeps = critic.clearance().at(np.array([[1.8, 0.6], [0.5, 0.6], [1.8, 2.2]]))
    assert keeps[0] > 0.3 and (keeps[1:] < 0.0).all()


ROOM = (1.08, 1.62, 0.46, 0.74)  # hardly more than a car at FACING needs
STRAIGHT_BEHIND = np.array([-0.6, 0.6, 0.0])


def in_a_corner(*known: tuple[float, float, float, float]) -> GrowingCritic:
    critic = GrowingCritic(CAR, STRAIGHT_BEHIND, HALF_ANGLE, CONFIG)
    critic.update(seen(ROOM, *known), FACING)
    return critic


def test_where_it_dares_the_unseen_is_no_obstacle_and_it_is_careful():
    critic = in_a_corner()
    onto = np.array([0.98, 0.6])
    back, on = np.array([-0.3, 0.0]), np.array([0.3, 0.0])
    assert critic.clearance().at(onto) > 0.0  # there is no other way
    assert critic.careful(FACING, back) and not critic.careful(FACING, on)


def test_it_dares_one_motion_at_a_time():
    """Hold what lies behind the first blind motion for an obstacle until that was driven; then decide again."""
    critic = in_a_corner()
    first, beyond = np.array([0.98, 0.6]), np.array([0.6, 0.6])
    keeps = critic.clearance()
    assert keeps.at(first) > 0.0 and keeps.at(beyond) < 0.0
    computed = critic.computed
    critic.update(seen(ROOM, (0.9, 1.62, 0.44, 0.76)), FACING - [0.15, 0.0, 0.0])
    assert critic.computed == computed + 1
    keeps = critic.clearance()
    assert keeps.at(np.array([0.84, 0.6])) > 0.0 and keeps.at(np.array([0.4, 0.6])) < 0.0


def test_what_it_dares_keeps_its_price():
    """A motion backwards onto unseen cells counts as before where it may be driven."""
    critic = in_a_corner()
    back = critic.value.counted(np.array([[0.95, 0.6, 0.0]]), np.array([-1.0]))
    assert critic.clearance().at(np.array([0.98, 0.6])) > 0.0 and back == CONFIG.unknown[1]


@pytest.mark.slow
def test_where_it_does_not_get_on_unseen_space_becomes_cheaper_until_it_has_driven_there():
    critic, price = in_a_corner(), CONFIG.unknown[1]
    there, back = np.array([[0.95, 0.6, 0.0]]), np.array([-1.0])
    for _ in range(2):
        assert critic.dare(FACING)
        critic.update(seen(ROOM), FACING)
        price = 1.0 + 0.5 * (price - 1.0)
        np.testing.assert_allclose(critic.value.counted(there, back), price)
    driven = (0.9, 1.62, 0.44, 0.76)
    critic.update(seen(driven), FACING - [0.15, 0.0, 0.0])
    np.testing.assert_allclose(critic.value.counted(there - [[0.4, 0.0, 0.0]], back), CONFIG.unknown[1])


def unseen_in(known: FloorPlan, *places: tuple[float, float]) -> list[bool]:
    critic = GrowingCritic(CAR, STRAIGHT_BEHIND, HALF_ANGLE, CONFIG)
    critic.update(known, FACING)
    cells = np.round((np.array(places) - critic._corner) / CELL).astype(int)
    return [bool(critic._window.unseen[tuple(cell)]) for cell in cells]


def test_the_first_unknown_cell_behind_a_car_is_unseen():
    """It counted as seen, and the car backed onto a wall there."""
    assert unseen_in(seen(ROOM), (1.05, 0.6), (1.0, 0.6), (1.65, 0.6), (1.3, 0.8)) == [True] * 4


def test_what_known_cells_enclose_counts_as_seen():
    """A gap of a cell between known ones; and one between a free cell and an obstacle."""
    gap = seen((0.9, 1.1, 0.45, 0.75), (1.2, 1.4, 0.45, 0.75))
    assert unseen_in(gap, (1.15, 0.6), (1.15, 0.9), (0.85, 0.6)) == [False, True, True]
    gap.cells[tuple(gap.index(np.array([1.5, 0.6])))] = OCCUPIED
    assert unseen_in(gap, (1.45, 0.6), (1.55, 0.6)) == [False, True]


def test_it_decides_anew_where_it_has_driven_what_it_dared():
    """Also where little of it became known: the cells beside the car stay unknown."""
    critic = in_a_corner()
    computed, until = critic.computed, critic._until
    critic.update(seen(ROOM), FACING)
    assert critic.computed == computed and critic.motions(FACING) > until
    route = descend(critic._followed, FACING, CAR)
    critic.update(seen(ROOM), route[1])
    assert critic.computed == computed + 1


def test_it_decides_anew_before_it_dares_where_much_was_seen_meanwhile():
    critic = in_a_corner()
    elsewhere = seen(ROOM, (1.0, 1.6, 1.4, 1.9))
    critic.update(elsewhere, FACING)  # at once after the last computation: it waits
    assert critic.computed == 1 and critic.dare(FACING)
    critic.update(elsewhere, FACING)
    back = critic.value.counted(np.array([[0.95, 0.6, 0.0]]), np.array([-1.0]))
    assert critic.computed == 2 and back == CONFIG.unknown[1]


def test_it_is_led_onto_what_it_dares_and_no_further():
    """The route of a car that does not get on ends where it has driven the one motion that it dares."""
    critic = in_a_corner()
    assert critic.dare(FACING)
    critic.update(seen(ROOM), FACING)
    route = critic.lead(FACING)
    np.testing.assert_array_equal(route[0], FACING)
    dared = {tuple(cell) for cell in critic._daring}
    sight = critic._sight(critic._window.unseen)
    met = {tuple(cell) for cell in sight.swept(route)}
    assert met and met <= dared
    following = descend(critic._followed, FACING, CAR)
    assert len(route) < len(following)
    np.testing.assert_array_equal(route, following[: len(route)])


def under(critic, cells, pose):
    """Return which of the set cells lie under the car at a pose."""
    found = critic._window.under(pose, CAR, 0.0)
    return {tuple(cell) for cell in found[cells[tuple(found.T)]].tolist()}


def test_where_no_motion_is_free_a_short_arc_leads_to_the_best_pose():
    """It dares nothing, and a whole motion would meet unseen cells."""
    critic = in_a_corner()
    critic._dare(np.zeros((0, 2), int))
    route = critic.lead(FACING)
    assert len(route) == 2 and 0.0 < FACING[0] - route[1][0] < 0.1
    assert critic.value.reachable(route[1]) and not under(critic, critic._window.unseen, route[1])


def test_a_short_arc_meets_no_other_cells_than_the_car_does_where_it_stands():
    """Three cells under its rear are an error of the map; three ahead of it, where it costs less, it may not trade."""
    critic = in_a_corner((0.9, 2.2, 0.2, 1.0))
    values = np.asarray(critic._followed.values)
    cheaper_ahead = np.broadcast_to(90.0 - np.arange(len(values))[:, None, None], values.shape).astype(np.float32)
    followed = replace(critic._followed, values=cheaper_ahead)
    out = lambda: way_out(followed, FACING, CAR, critic._window, critic._dared)
    assert out()[1][0] > FACING[0] + 0.1
    cells, met = critic._window.cells, lambda pose: under(critic, critic._window.occupied, pose)
    for y in (0.55, 0.6, 0.65):
        for x in (1.15, 1.6):
            cells[tuple(np.round((np.array([x, y]) - critic._corner) / CELL).astype(int))] = OCCUPIED
    assert len(met(FACING)) == 3
    end = out()[1]
    assert met(end) <= met(FACING) and end[0] < FACING[0] + 0.05


def test_it_does_not_dare_where_everything_was_seen():
    critic = critic_after(plan(9.0))
    assert not critic.looks and not critic.dare(START)


@pytest.mark.slow
def test_the_way_around_unknown_space_is_taken_where_it_is_short():
    """Unknown cells cost their motions: a route through known space is preferred, and an unknown one is none worse."""
    dark = plan(3.0)
    dark.cells[38:42, 20:52] = UNKNOWN  # x 0.9 to 1.1, y 0 to 1.6: over the straight line
    around = descend(critic_after(dark).value, START, CAR)
    straight = descend(critic_after(plan(3.0)).value, START, CAR)
    length = lambda route: np.hypot(*np.diff(route[:, :2], axis=0).T).sum()
    assert length(straight) <= length(around) < 2.0 * length(straight)
    assert critic_after(dark).value.at(START) >= critic_after(plan(3.0)).value.at(START) - 0.02
