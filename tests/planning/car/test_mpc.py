"""Test the three controllers on problems with known solutions, and the contract of all of them."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import mpc_worlds as worlds
from vssm_gym.errors import InputError
from vssm_gym.planning.mpc.ipopt import Ipopt
from vssm_gym.planning.mpc.mppi import Mppi, MppiConfig
from vssm_gym.planning.mpc.problem import MpcConfig, MpcProblem, MpcStatus
from vssm_gym.planning.mpc.random_search import RandomSearch, RandomSearchConfig

CONFIG = MpcConfig(horizon=15, deadline=float("inf"), proximity=0.0)
PROBLEM = MpcProblem(config=CONFIG)
SOLVERS = {
    "random search": RandomSearch(PROBLEM, RandomSearchConfig(candidates=256)),
    "ipopt": Ipopt(PROBLEM),
    "mppi": Mppi(PROBLEM, MppiConfig(samples=256)),
}
OPEN = worlds.clearance_of(lambda x, y: 1.9)
AHEAD = worlds.value_of(lambda x, y, h: np.hypot(x - 1.5, y) / worlds.MOTION)
WALL = 0.4  # m ahead of the rear axle's world origin

each = pytest.mark.parametrize("solver", list(SOLVERS.values()), ids=list(SOLVERS))


def best(solver, state, value, clearance, calls: int = 6):
    """Return the cheapest plan of a few calls, each with its own random numbers."""
    results, warm = [], None
    for _ in range(calls):
        warm = solver.plan(np.array(state, float), value, clearance, warm, np.zeros(2))
        results.append(warm)
    return min((r for r in results if r.usable), key=lambda r: r.cost)


@each
def test_in_the_open_it_drives_straight_at_full_speed(solver) -> None:
    """With a conical cost-to-go, the rate limit is active first, then the speed limit, without steering."""
    result = best(solver, (0.0, 0.0, 0.0), AHEAD, OPEN)
    assert result.usable
    np.testing.assert_allclose(result.controls[0, 0], PROBLEM.rates[0], atol=0.01)
    np.testing.assert_allclose(result.controls[1:, 0], PROBLEM.car.max_speed, atol=0.01)
    np.testing.assert_allclose(result.states[-1, :2], [0.06 * 14.5, 0.0], atol=0.01)


@each
def test_backwards_where_the_goal_is_behind(solver) -> None:
    result = best(solver, (0.0, 0.0, np.pi - 0.01), AHEAD, OPEN)
    np.testing.assert_allclose(result.controls[1:, 0], -PROBLEM.car.max_speed, atol=0.02)
    assert result.states[-1, 0] > 0.8


@each
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_to_turn_it_goes_to_full_lock(solver, side: float) -> None:
    """With a cost of heading only, every step turns by ``v dt tan(full lock) / wheelbase`` once rates allow."""
    value = worlds.value_of(lambda x, y, h: 5.0 + 3.0 * np.abs(worlds.wrapped(h - 2.5 * side)))
    result = best(solver, (0.0, 0.0, 0.0), value, OPEN)
    turns = np.diff(np.unwrap(result.states[:, 2]))
    np.testing.assert_allclose(np.abs(result.controls[2:, 1]), PROBLEM.car.max_steering, atol=0.02)
    np.testing.assert_allclose(turns[2:], side * 0.06 / PROBLEM.car.turning_radius, atol=0.006)


@each
def test_it_stops_at_a_wall_at_exactly_the_margin(solver) -> None:
    """With the goal behind a wall the constraint is active at the end, and nowhere violated."""
    wall = worlds.clearance_of(lambda x, y: WALL - x)
    value = worlds.value_of(lambda x, y, h: (1.9 - x) / worlds.MOTION + 5.0 * np.abs(worlds.wrapped(h)))
    result = best(solver, (-0.2, 0.0, 0.0), value, wall)
    centres, radius = PROBLEM.discs
    assert result.violation <= CONFIG.tolerance
    assert result.clearance_min == pytest.approx(CONFIG.margin, abs=1e-3 if not isinstance(solver, Mppi) else 5e-3)
    expected = WALL - CONFIG.margin - radius - centres[:, 0].max()
    assert result.states[:, 0].max() == pytest.approx(expected, abs=3e-3 if not isinstance(solver, Mppi) else 8e-3)


@pytest.mark.parametrize(
    ("state", "value", "clearance"),
    [
        ((0.0, 0.0, 0.0), AHEAD, OPEN),
        ((0.2, 0.4, -1.0), AHEAD, OPEN),
        ((-0.3, -0.2, 0.8), AHEAD, worlds.clearance_of(lambda x, y: 0.3 - y)),
    ],
    ids=["ahead", "aside", "under a wall"],
)
def test_the_three_controllers_agree_on_an_easy_problem(state, value, clearance) -> None:
    results = {name: best(solver, state, value, clearance) for name, solver in SOLVERS.items()}
    costs = {name: result.cost for name, result in results.items()}
    assert max(costs.values()) - min(costs.values()) < 0.25, costs
    for result in results.values():
        np.testing.assert_allclose(result.controls[0], results["ipopt"].controls[0], atol=0.15)


@each
def test_a_result_is_consistent_with_its_controls(solver) -> None:
    """States, cost and clearance are those of the controls; controls keep limits and rates."""
    state, clearance = np.array([-0.3, -0.2, 0.8]), worlds.clearance_of(lambda x, y: 0.3 - y)
    result = solver.plan(state, AHEAD, clearance)
    cost, states, clear = worlds.Oracle(PROBLEM, AHEAD, clearance)(state, np.zeros(2), result.controls)
    np.testing.assert_allclose(result.states[1:, :2], states[:, :2], atol=1e-5)
    np.testing.assert_allclose(result.states[0], state, atol=1e-6)
    assert result.cost == pytest.approx(cost, rel=1e-4)
    assert result.clearance_min == pytest.approx(clear.min(), abs=1e-5)
    assert (np.abs(result.controls) <= PROBLEM.car.limits + 1e-6).all()
    assert (np.abs(np.diff(result.controls, axis=0, prepend=np.zeros((1, 2)))) <= PROBLEM.rates + 1e-6).all()
    assert 0.0 < result.seconds < 60.0


@each
def test_it_is_at_rest_once_it_has_arrived(solver) -> None:
    value = worlds.value_of(lambda x, y, h: np.maximum(0.0, np.hypot(x, y) - 0.2) / worlds.MOTION)
    result = best(solver, (0.0, 0.0, 1.0), value, OPEN)
    np.testing.assert_allclose(result.controls[:, 0], 0.0, atol=0.03)
    assert result.cost < 0.05


@each
def test_a_car_that_cannot_stop_in_time_has_no_feasible_plan(solver) -> None:
    """At full speed 2 cm before the margin: two steps of braking take 3 cm."""
    centres, radius = PROBLEM.discs
    x = WALL - 0.02 - CONFIG.margin - radius - centres[:, 0].max()
    wall = worlds.clearance_of(lambda x, y: WALL - x)
    result = solver.plan(np.array([x, 0.0, 0.0]), AHEAD, wall, None, np.array([0.6, 0.0]))
    assert result.status is MpcStatus.INFEASIBLE
    assert not result.usable
    assert result.violation > CONFIG.tolerance
    assert np.isfinite(result.controls).all()


@each
def test_a_start_inside_an_obstacle_is_blocked(solver) -> None:
    wall = worlds.clearance_of(lambda x, y: WALL - x)
    assert solver.plan(np.array([WALL, 0.0, 0.0]), AHEAD, wall).status is MpcStatus.BLOCKED


@each
def test_below_the_margin_it_may_leave(solver) -> None:
    """A car 4 mm too close after a noisy step is not stuck, and no plan comes closer."""
    centres, radius = PROBLEM.discs
    state = np.array([WALL - 0.006 - radius - centres[:, 0].max(), 0.0, 0.0])
    behind = worlds.value_of(lambda x, y, h: np.hypot(x + 1.5, y) / worlds.MOTION)
    result = solver.plan(state, behind, worlds.clearance_of(lambda x, y: WALL - x))
    assert result.usable
    assert result.states[-1, 0] < state[0] - 0.5


@each
def test_the_same_question_has_the_same_answer(solver) -> None:
    state, clearance = np.array([-0.3, -0.2, 0.8]), worlds.clearance_of(lambda x, y: 0.3 - y)
    first = solver.plan(state, AHEAD, clearance)
    solver.plan(np.array([0.5, 0.5, 0.0]), AHEAD, OPEN, first)
    again = solver.plan(state, AHEAD, clearance)
    np.testing.assert_array_equal(first.controls, again.controls)
    np.testing.assert_array_equal(
        solver.plan(first.states[1], AHEAD, clearance, first).controls,
        solver.plan(first.states[1], AHEAD, clearance, again).controls,
    )


@pytest.mark.slow
def test_another_seed_draws_other_numbers() -> None:
    """Few samples are drawn where no constant arc is best, so that the seed matters."""
    plans = []
    for seed in (0, 1):
        problem = MpcProblem(config=replace(CONFIG, seed=seed))
        solver, under_a_wall = (
            Mppi(problem, MppiConfig(samples=64, rounds=2)),
            worlds.clearance_of(lambda x, y: 0.3 - y),
        )
        plans.append(solver.plan(np.array([-0.3, -0.2, 0.8]), AHEAD, under_a_wall).controls)
    assert np.abs(plans[0] - plans[1]).max() > 1e-3


@each
def test_nothing_compiles_between_steps_goals_and_maps(solver) -> None:
    """Each compiled part has one entry after other poses, goals, maps, controls and warm starts of the same shape."""
    state, result = np.array([0.1, 0.1, 0.3]), None
    for k in range(12):
        value = worlds.value_of(lambda x, y, h, k=k: np.hypot(x - 0.1 * k, y) / worlds.MOTION) if k % 4 == 0 else AHEAD
        clearance = worlds.clearance_of(lambda x, y, k=k: 0.9 + 0.01 * k - y)
        result = solver.plan(state, value, clearance, result, np.array([0.1, 0.01 * k]))
        state = result.states[1]
    if isinstance(solver, Ipopt):
        assert (solver._begin._cache_size(), solver._end._cache_size(), len(solver._solvers)) == (1, 1, 1)
    else:
        assert solver._compiled.search._cache_size() == 1


def test_ipopt_starts_where_it_left_off() -> None:
    """From the next pose of its plan, the old multipliers save most iterations."""
    solver, state, result, iterations = SOLVERS["ipopt"], np.array([-0.3, -0.2, 0.8]), None, []
    clearance = worlds.clearance_of(lambda x, y: 0.3 - y)
    for _ in range(5):
        result = solver.plan(state, AHEAD, clearance, result)
        state, iterations = result.states[1], [*iterations, result.iterations]
    assert np.mean(iterations[1:]) < iterations[0], iterations


def test_random_search_finds_no_worse_than_a_constant_arc() -> None:
    solver, state = SOLVERS["random search"], np.array([0.2, 0.4, -1.0])
    result, oracle = solver.plan(state, AHEAD, OPEN), worlds.Oracle(PROBLEM, AHEAD, OPEN)
    speed = np.minimum(PROBLEM.rates[0] * np.arange(1, 16), PROBLEM.car.max_speed)
    for steering in (-0.5, 0.0, 0.25, 0.5):
        angle = np.clip(PROBLEM.rates[1] * np.arange(1, 16), 0.0, abs(steering) * PROBLEM.car.max_steering)
        arc = np.stack([speed, np.sign(steering) * angle], axis=-1)
        assert result.cost <= oracle(state, np.zeros(2), arc)[0] + 0.02


@each
@pytest.mark.parametrize("state", [np.zeros(2), np.array([0.0, np.nan, 0.0])])
def test_a_bad_pose_is_named(solver, state: np.ndarray) -> None:
    with pytest.raises(InputError, match="state"):
        solver.plan(state, AHEAD, OPEN)


@pytest.mark.parametrize("config", [{"candidates": 5}, {"refined": 0}, {"refined": 1000}])
def test_a_bad_random_search_is_named(config: dict) -> None:
    with pytest.raises(InputError, match=next(iter(config))):
        RandomSearchConfig(**config)


@pytest.mark.parametrize("config", [{"samples": 5}, {"rounds": 0}, {"temperature": 0.0}, {"shrink": 1.5}])
def test_a_bad_mppi_is_named(config: dict) -> None:
    with pytest.raises(InputError, match=next(iter(config))):
        MppiConfig(**config)
