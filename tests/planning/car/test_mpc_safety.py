"""Test the car without a plan from its controller: it continues, brakes or backs off, and never comes closer."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import mpc_worlds as worlds
from vssm_gym.planning.mpc import safety
from vssm_gym.planning.mpc.problem import MpcConfig, MpcProblem, MpcResult, MpcStatus
from vssm_gym.planning.mpc.safety import SafeKind, SafeMemory

PROBLEM = MpcProblem(config=MpcConfig(horizon=15))
CENTRES, RADIUS = PROBLEM.discs
FRONT = RADIUS + CENTRES[:, 0].max()  # m ahead of the rear axle
OPEN = worlds.clearance_of(lambda x, y: 1.9)
NOTHING = np.zeros((0, 2))


def wall_ahead(gap: float):
    """Return the clearance of a wall at a distance (m) before the discs of a car at the origin."""
    return worlds.clearance_of(lambda x, y: gap + FRONT - x)


def answer(status: MpcStatus, controls: np.ndarray | None = None) -> MpcResult:
    controls = np.tile([0.6, 0.1], (15, 1)) if controls is None else controls
    return MpcResult(status, controls, np.zeros((16, 3)), 1.0, 0.0, 0.1, 0.01)


def act(memory: SafeMemory, result: MpcResult, clearance, state=(0.0, 0.0, 0.0)):
    return safety.step(PROBLEM, memory, result, np.array(state), clearance)


@pytest.mark.parametrize("status", [MpcStatus.SOLVED, MpcStatus.ACCEPTABLE])
def test_a_usable_plan_is_driven_and_remembered(status: MpcStatus) -> None:
    result = answer(status)
    memory, action = act(safety.init(np.zeros(2)), result, OPEN)
    assert action.kind is SafeKind.PLANNED
    np.testing.assert_array_equal(action.control, result.controls[0])
    assert memory.resume is result
    np.testing.assert_array_equal(memory.came, result.controls[:1])


def test_while_plans_are_late_the_last_one_is_driven_to_its_end() -> None:
    controls = np.stack([np.full(15, 0.5), np.linspace(0.0, 0.14, 15)], axis=-1)
    memory, _ = act(safety.init(np.zeros(2)), answer(MpcStatus.SOLVED, controls), OPEN)
    memory = replace(memory, control=controls[0])
    for k in range(1, 15):
        memory, action = act(memory, answer(MpcStatus.LATE), OPEN)
        assert action.kind is SafeKind.CONTINUED
        np.testing.assert_allclose(action.control, controls[k], atol=1e-6)
    memory, action = act(memory, answer(MpcStatus.LATE), OPEN)
    assert action.kind is SafeKind.BRAKED
    assert abs(action.control[0]) == pytest.approx(0.5 - PROBLEM.rates[0], abs=1e-6)
    memory, _ = act(memory, answer(MpcStatus.LATE), OPEN)
    memory, action = act(memory, answer(MpcStatus.LATE), OPEN)
    assert action.kind is SafeKind.HELD
    assert action.control[0] == 0.0


def test_a_last_plan_that_is_no_longer_free_is_not_continued() -> None:
    memory = SafeMemory(np.array([0.6, 0.0]), np.tile([0.6, 0.0], (15, 1)), NOTHING)
    _, action = act(memory, answer(MpcStatus.LATE), wall_ahead(0.2))
    assert action.kind is SafeKind.BRAKED
    np.testing.assert_allclose(action.control, [0.6 - PROBLEM.rates[0], 0.0], atol=1e-6)


def test_infeasible_without_a_plan_brakes() -> None:
    memory = SafeMemory(np.array([-0.6, 0.2]), NOTHING, NOTHING)
    _, action = act(memory, answer(MpcStatus.INFEASIBLE), OPEN)
    assert action.kind is SafeKind.BRAKED
    np.testing.assert_allclose(action.control, [-0.6 + PROBLEM.rates[0], 0.2], atol=1e-6)


def test_inside_an_obstacle_it_backs_off_along_its_path() -> None:
    """Two centimetres into a wall after six steps forward on an arc: it retraces them and forgets them."""
    came = np.tile([0.3, 0.2], (6, 1))
    memory, state, kinds = SafeMemory(np.zeros(2), NOTHING, came), np.zeros(3), []
    clearance = wall_ahead(-0.02)
    for _ in range(3):
        memory, action = act(memory, answer(MpcStatus.BLOCKED), clearance, state)
        kinds.append(action.kind)
        turn = action.control[0] * 0.1 * np.tan(action.control[1]) / PROBLEM.car.wheelbase
        state = state + np.array([action.control[0] * 0.1, 0.0, turn])
    assert kinds == [SafeKind.BACKED_OFF] * 3
    assert len(memory.came) == 3
    assert state[0] < -0.05
    assert memory.resume is None


def test_where_the_path_back_is_blocked_it_takes_the_solvers_path() -> None:
    """With a wall behind, the path it came leads deeper, and the solver's leads out."""
    centres = CENTRES[:, 0]
    behind = worlds.clearance_of(lambda x, y: x - centres.min() + RADIUS - 0.02)
    memory = SafeMemory(np.zeros(2), NOTHING, np.tile([0.3, 0.0], (5, 1)))
    out = np.tile([0.3, 0.0], (15, 1))
    _, action = act(memory, answer(MpcStatus.BLOCKED, out), behind)
    assert action.kind is SafeKind.ESCAPED
    np.testing.assert_allclose(action.control, [0.3, 0.0], atol=1e-6)
    _, action = act(memory, answer(MpcStatus.BLOCKED, -out), behind)
    assert action.kind is SafeKind.HELD


@pytest.mark.parametrize("status", [s for s in MpcStatus if not s.usable])
@pytest.mark.parametrize("gap", [-0.05, -0.01, 0.005, 0.03, 0.5])
def test_an_action_either_stops_or_leads_no_closer_than_a_plan_may(status: MpcStatus, gap: float) -> None:
    """An oracle computes the pose after the step, from random memories before a wall."""
    rng, clearance = np.random.default_rng(abs(round(1000 * gap))), wall_ahead(gap)
    oracle = worlds.Oracle(PROBLEM, worlds.value_of(lambda x, y, h: 0.0 * x), clearance)
    stops = 0
    for _ in range(20):
        last = rng.uniform(-1, 1, 2) * PROBLEM.car.limits
        plan, came = rng.uniform(-1, 1, (2, 15, 2)) * PROBLEM.car.limits
        _, action = act(SafeMemory(last, plan, came), answer(status, plan), clearance)
        assert (np.abs(action.control - last) <= PROBLEM.rates + 1e-6).all()
        if action.kind in (SafeKind.BRAKED, SafeKind.HELD):
            stops += 1
            braked = np.sign(last[0]) * max(0.0, abs(last[0]) - PROBLEM.rates[0])
            assert action.control[0] == pytest.approx(braked, abs=1e-6)
        else:
            after = oracle(np.zeros(3), last, action.control[None])[2].min()
            assert after >= min(gap, PROBLEM.config.margin) - PROBLEM.config.tolerance - 1e-5
    assert stops < 20 or gap < 0.5


def test_every_status_and_action_has_a_message() -> None:
    assert all(status.message for status in MpcStatus)
    assert all(kind.message for kind in SafeKind)
    assert len({kind.message for kind in SafeKind}) >= 5


def test_a_late_plan_is_not_usable() -> None:
    assert answer(MpcStatus.SOLVED).within_deadline(0.001).status is MpcStatus.LATE
    assert answer(MpcStatus.SOLVED).within_deadline(0.1).status is MpcStatus.SOLVED
