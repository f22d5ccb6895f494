"""Test hybrid A*: plans are drivable, collision-free and short, and unreachable goals are reported."""

import dataclasses
import math

import numpy as np
import pytest

from tests.helpers.car_worlds import CAR, DEAD_END, PARKED, PARKING, SEALED, collides, levels, move, occupied, solid
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car import reeds_shepp
from vssm_gym.planning.car.footprint_levels import CLEAR, COLLIDING, FootprintLevels
from vssm_gym.planning.car.hybrid_astar import CarPlan, HybridAStarConfig, arcs, plan
from vssm_gym.planning.car.hybrid_search import Costs
from vssm_gym.planning.result import PlanResult, PlanStatus

RADIUS = HybridAStarConfig().radius(CAR)
OPEN = levels(occupied(8.0, 8.0))
LENGTH_ALONE = HybridAStarConfig(Costs(0.0, 0.0, 0.0, 0.0))


def check_drivable(result: CarPlan, grid: np.ndarray, start: np.ndarray, goal: np.ndarray) -> None:
    """Assert that a plan reaches the goal over feasible arcs, in its gears, without collision of the exact outline."""
    assert result.found, result.status
    poses, gears = result.poses, result.gears
    np.testing.assert_allclose(poses[0, :2], start[:2])
    np.testing.assert_allclose(poses[-1, :2], goal[:2], atol=1e-6)
    if len(goal) == 3:
        assert abs(wrap_angle(poses[-1, 2] - np.array(goal[2]))) < 1e-6
    assert np.all((poses[:, 2] >= -np.pi) & (poses[:, 2] < np.pi))
    turn = wrap_angle(np.diff(poses[:, 2]))
    chord = np.diff(poses[:, :2], axis=0)
    length = np.hypot(*chord.T) / np.sinc(0.5 * turn / np.pi)
    assert np.all(np.abs(turn) <= length / RADIUS + 1e-6)
    assert result.cost == pytest.approx(length.sum())
    # A hop lies along the heading halfway, forwards or backwards as the gear says: one arc, no sideways slip
    middle = poses[:-1, 2] + 0.5 * turn
    along = chord[:, 0] * np.cos(middle) + chord[:, 1] * np.sin(middle)
    across = chord[:, 1] * np.cos(middle) - chord[:, 0] * np.sin(middle)
    np.testing.assert_allclose(across, 0.0, atol=1e-6)
    assert np.all(along * gears[1:] >= -1e-9)
    assert result.cusps == np.count_nonzero(np.diff(np.sign(along[np.abs(along) > 1e-9])))
    assert not collides(solid(grid), poses).any()


@pytest.mark.parametrize("seed", range(12))
def test_without_obstacles_a_plan_is_the_reeds_shepp_path(seed):
    rng = np.random.default_rng(seed)
    start, goal = (np.array([*rng.uniform(2.5, 5.5, 2), rng.uniform(-3.1, 3.1)]) for _ in range(2))
    result = plan(start, goal, OPEN, CAR, config=LENGTH_ALONE)
    check_drivable(result, occupied(8.0, 8.0), start, goal)
    assert result.cost == pytest.approx(float(reeds_shepp.length(start, goal, RADIUS)), rel=3e-5)


@pytest.mark.parametrize(
    ("grid", "start", "goal", "cusps"),
    [
        (PARKING, np.array([1.2, 0.9, math.pi]), np.array([1.33, 0.16, math.pi]), 1),
        (PARKING, np.array([0.4, 0.7, 0.0]), PARKED, 1),
        (PARKING, PARKED, np.array([2.0, 1.2, 1.0]), 0),
        (DEAD_END, np.array([0.5, 1.0, math.pi]), np.array([0.5, 0.35, math.pi]), 1),
        (DEAD_END, np.array([2.5, 0.4, 1.5]), np.array([0.5, 1.0, 0.0]), 0),
        (DEAD_END, np.array([2.5, 0.4, 1.5]), np.array([0.4, 1.6]), 0),
    ],
)
def test_hand_made_places(grid, start, goal, cusps):
    result = plan(start, goal, levels(grid), CAR)
    check_drivable(result, grid, start, goal)
    assert result.cusps >= cusps
    bound = float(reeds_shepp.length(start, goal, RADIUS)) if len(goal) == 3 else math.hypot(*(goal - start[:2]))
    assert result.cost >= bound - 1e-9


def test_the_car_backs_out_of_a_narrow_corridor():
    result = plan(np.array([0.5, 1.0, math.pi]), np.array([2.6, 0.3]), levels(DEAD_END), CAR)
    inside = (result.poses[:, 0] < 1.8) & (result.poses[:, 1] > 0.8)
    assert np.all(result.gears[inside] == -1)


@pytest.mark.parametrize("goal", [np.array([2.5, 1.0, 0.0]), np.array([2.5, 1.0])])
def test_a_sealed_goal_is_refused_at_once(goal):
    result = plan(np.array([0.5, 0.5, 0.0]), goal, levels(SEALED), CAR)
    assert result.status is PlanStatus.NO_PATH
    assert result.expansions == 0
    assert result.path.shape == (0, 2)
    assert result.cost == math.inf


def test_a_niche_too_narrow_for_the_car_is_searched_and_refused():
    """The axle fits into the niche, but the car cannot drive in, which only the search finds out."""
    grid = occupied(1.6, 1.2, (0.95, 0.0, 1.0, 0.45), (0.95, 0.7, 1.0, 1.2))
    result = plan(np.array([0.4, 0.6, 0.0]), np.array([1.3, 0.6, 1.57]), levels(grid), CAR)
    assert result.status is PlanStatus.NO_PATH
    assert result.expansions > 0


@pytest.mark.parametrize("goal", [np.array([0.5, 0.1, 0.0]), np.array([0.5, 0.1]), np.array([99.0, 0.0])])
def test_a_goal_inside_an_obstacle_is_refused(goal):
    assert plan(np.array([1.2, 1.0, 0.0]), goal, levels(PARKING), CAR).status is PlanStatus.GOAL_BLOCKED


def test_a_start_in_contact_with_a_wall_leaves_it():
    start, goal = np.array([0.5, 0.42, 0.0]), np.array([1.8, 1.2, 0.0])
    table = levels(PARKING)
    assert table.at(start) == COLLIDING
    result = plan(start, goal, table, CAR)
    assert result.found
    level = table.at(result.poses)
    out = int(np.argmax(level < COLLIDING))
    assert not (level[out:] == COLLIDING).any()  # once out it stays out


def test_a_start_deep_inside_an_obstacle_is_refused():
    grid = occupied(4.0, 4.0, (0.5, 0.5, 3.0, 3.0))
    result = plan(np.array([1.7, 1.7, 0.0]), np.array([3.5, 3.5]), levels(grid), CAR)
    assert result.status is PlanStatus.START_BLOCKED


def test_a_budget_ends_the_search_with_a_partial_plan():
    grid = occupied(4.0, 3.0, (1.9, 0.0, 2.0, 2.3))
    start, goal = np.array([0.5, 0.5, 0.0]), np.array([3.5, 0.5, 0.0])
    result = plan(start, goal, levels(grid), CAR, max_expansions=40)
    assert result.status is PlanStatus.TIME_OUT
    assert result.expansions == 40
    assert len(result.poses) > 1
    assert plan(start, goal, levels(grid), CAR, time_limit=0.0).status is PlanStatus.TIME_OUT
    check_drivable(plan(start, goal, levels(grid), CAR), grid, start, goal)


def test_the_same_question_has_the_same_answer():
    start, goal = np.array([0.4, 0.7, 0.0]), PARKED
    once, again = (plan(start, goal, levels(PARKING), CAR) for _ in range(2))
    np.testing.assert_array_equal(once.poses, again.poses)


@pytest.mark.parametrize("seed", range(6))
def test_a_finer_search_is_hardly_better(seed):
    """Cells of half the size and nine steering angles measure the cost of the resolution among obstacles."""
    rng = np.random.default_rng(seed)
    grid = occupied(3.0, 3.0, *[(x, y, x + 0.3, y + 0.3) for x, y in rng.uniform(0.4, 2.3, (4, 2))])
    table = levels(grid)
    rows = rng.uniform([0.2, 0.2, -3.1], [2.8, 2.8, 3.1], (200, 3))
    start, goal = rows[table.at(rows) == CLEAR][:2]
    coarse = plan(start, goal, table, CAR)
    fine = plan(start, goal, table, CAR, config=HybridAStarConfig(cell=0.05, headings=144, steerings=9))
    check_drivable(coarse, grid, start, goal)
    assert drive_cost(table, coarse) <= 1.2 * drive_cost(table, fine) + 0.1


def drive_cost(table: FootprintLevels, result: CarPlan) -> float:
    """Compute the module's objective from poses and gears alone, without the steering."""
    hops = np.hypot(*np.diff(result.path, axis=0).T)
    near = table.at(result.poses[1:]) != CLEAR
    costs = Costs()
    weight = 1.0 + costs.reverse * (result.gears[1:] < 0) + costs.tight * near
    return float((hops * weight).sum()) + costs.cusp * result.cusps


def test_arcs_equal_the_cars_motion():
    moves = arcs(0.15, RADIUS, 5, 0.025)
    for k in range(10):
        steering = math.atan(CAR.wheelbase * moves.steering[k] / RADIUS)
        planar = np.zeros(3)
        for d in moves.displacement[k]:
            planar = move(planar, np.array([moves.gear[k], steering]), dt=0.025)
            np.testing.assert_allclose(planar, d, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "field"),
    [({"start": np.zeros(2)}, "start"), ({"goal": np.array([np.nan, 0.0])}, "goal")],
)
def test_bad_input_is_named(options, field):
    with pytest.raises(InputError, match=field):
        plan(obstacles=OPEN, car=CAR, **({"start": np.array([3.0, 3.0, 0.0]), "goal": np.array([4.0, 4.0])} | options))


def test_an_even_number_of_steerings_is_refused():
    """None of them would be straight."""
    with pytest.raises(InputError, match="steerings"):
        HybridAStarConfig(steerings=4)


def test_a_drive_has_the_fields_of_a_plan():
    """Reports print the same fields of a drive and of a path."""
    result = plan(np.array([1.0, 1.0, 0.0]), np.array([2.0, 1.5]), OPEN, CAR)
    for field in (*(field.name for field in dataclasses.fields(PlanResult)), "found"):
        assert hasattr(result, field)
    assert result.path.shape == (len(result.poses), 2)
