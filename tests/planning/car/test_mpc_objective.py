"""Test the controllers' objective against an oracle in float64: values, gradients, footprints, rates."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import mpc_worlds as worlds
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import Bicycle
from vssm_gym.planning.mpc import ipopt, objective
from vssm_gym.planning.mpc.cover import cover
from vssm_gym.planning.mpc.fields import make_fields
from vssm_gym.planning.mpc.lagrangian import lagrangian
from vssm_gym.planning.mpc.problem import MpcConfig, MpcProblem
from vssm_gym.planning.mpc.windows import ClearanceTable, ValueTable
from vssm_gym.planning.value_iteration import Counts

PROBLEM = MpcProblem(config=MpcConfig(horizon=8, comfort=0.3))
CONFIG = ipopt.IpoptConfig()
BICYCLE = Bicycle(wheelbase=PROBLEM.car.wheelbase)
START, LAST = np.array([0.3, -0.2, 2.6]), np.array([0.2, -0.1])


def bumpy():
    """Return a cost-to-go and a clearance with curvature everywhere; headings are near pi, where the table wraps."""
    value = worlds.value_of(lambda x, y, h: 8.0 + 3.0 * np.sin(2 * x) + 2.0 * np.cos(1.5 * y + x) + 2.0 * np.sin(h - x))
    clearance = worlds.clearance_of(lambda x, y: 0.25 + 0.15 * np.sin(4 * x) * np.cos(3 * y))
    return value, clearance


def hasty(haste: float) -> MpcProblem:
    return dataclasses.replace(PROBLEM, config=dataclasses.replace(PROBLEM.config, haste=haste))


def drawn(seed: int) -> np.ndarray:
    controls = np.random.default_rng(seed).uniform(-1.0, 1.0, (PROBLEM.config.horizon, 2)) * PROBLEM.car.limits
    return np.asarray(objective.within_rates(PROBLEM, jnp.asarray(LAST), jnp.asarray(controls)), np.float64)


@pytest.mark.parametrize(("seed", "haste"), [(0, 0.0), (1, 0.0), (2, 0.0), (0, 0.1)])
def test_values_are_those_of_the_definition(seed: int, haste: float) -> None:
    problem = hasty(haste)
    value, clearance = bumpy()
    controls = drawn(seed)
    cost, states, clearances = worlds.Oracle(problem, value, clearance)(START, LAST, controls)
    fields = make_fields(value, clearance, PROBLEM.car)
    plans = objective.evaluate(problem, fields, *(jnp.asarray(a, jnp.float32) for a in (START, LAST, controls)))
    np.testing.assert_allclose(plans.states, states, atol=2e-6)
    np.testing.assert_allclose(plans.clearance, clearances, atol=5e-6)
    np.testing.assert_allclose(plans.cost, cost, rtol=1e-5)


@pytest.mark.parametrize(("haste", "gained"), [(0.0, 0.0), (0.1, 1.0)])
def test_with_haste_it_is_cheaper_to_drive_a_little_way_at_once(haste: float, gained: float) -> None:
    """Two steps, now or at the end of the horizon: they end at one place, ten units short of the goal."""
    problem = hasty(haste)
    value = worlds.value_of(lambda x, y, h: 10.0 - x / worlds.MOTION + 0.0 * (y + h))
    fields = make_fields(value, worlds.clearance_of(lambda x, y: 1.0 + 0.0 * x), PROBLEM.car)
    plans = np.zeros((2, PROBLEM.config.horizon, 2))
    plans[0, 1:3, 0] = plans[1, -3:-1, 0] = 0.3
    cost = objective.evaluate(problem, fields, jnp.zeros(3), jnp.zeros(2), jnp.asarray(plans, jnp.float32)).cost
    steps = PROBLEM.config.horizon - 4  # by which one is later than the other, by one unit of the cost-to-go
    np.testing.assert_allclose(cost[1] - cost[0], gained * haste * steps, atol=0.04)


@pytest.mark.parametrize("seed", range(6))
def test_steps_over_unknown_cells_count_as_motions_do(seed: int) -> None:
    """A strip of poses counts 2 motions forwards and 7 backwards."""
    value, clearance = bumpy()
    over = np.broadcast_to((np.arange(value.values.shape[0]) % 2 == 0)[:, None, None], value.values.shape)
    value = dataclasses.replace(value, counts=Counts(over, np.array([2.0, 7.0], np.float32)))
    controls = drawn(seed)
    fields = make_fields(value, clearance, PROBLEM.car)
    plans = objective.evaluate(PROBLEM, fields, *(jnp.asarray(a, jnp.float32) for a in (START, LAST, controls)))
    assert fields.value.counts.poses.dtype == bool
    cost, _, _ = worlds.Oracle(PROBLEM, value, clearance)(START, LAST, controls)
    np.testing.assert_allclose(plans.cost, cost, rtol=1e-5)
    free = dataclasses.replace(value, counts=Counts(over, np.ones(2, np.float32)))
    known = dataclasses.replace(value, counts=None)
    same = [
        objective.evaluate(
            PROBLEM,
            make_fields(v, clearance, PROBLEM.car),
            *(jnp.asarray(a, jnp.float32) for a in (START, LAST, controls)),
        ).cost
        for v in (free, known)
    ]
    np.testing.assert_allclose(*same, rtol=1e-6)
    assert abs(float(plans.cost) - float(same[0])) > 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_of_the_lagrangian_is_that_of_finite_differences(seed: int) -> None:
    """Cost, active multipliers and penalty together; the oracle differentiates in float64."""
    value, clearance = bumpy()
    controls, oracle = drawn(seed), worlds.Oracle(PROBLEM, value, clearance)
    multipliers = np.random.default_rng(seed).uniform(0.0, 5.0, (8, len(PROBLEM.discs[0])))
    least, penalty = 0.2, 40.0

    def exact(u):
        cost, _, clear = oracle(START, LAST, u)
        raised = np.maximum(0.0, multipliers - penalty * (clear - least))
        return cost + np.sum(raised**2 - multipliers**2) / (2 * penalty)

    expected = worlds.finite_difference(exact, controls)
    fields = make_fields(value, clearance, PROBLEM.car)
    arrays = [jnp.asarray(a, jnp.float32) for a in (START, LAST, least, multipliers, penalty, controls)]
    total = lambda u: lagrangian(PROBLEM, fields, *arrays[:-1], u)[0]
    np.testing.assert_allclose(jax.grad(total)(arrays[-1]), expected, atol=2e-3 * np.abs(expected).max())


def test_ipopts_derivatives_are_exact() -> None:
    """Gradient, Jacobian and Hessian of the NLP equal finite differences in float64, away from solutions."""
    value, clearance = bumpy()
    values, clearances = ValueTable(value, CONFIG.reach), ClearanceTable(clearance, 1.0)
    solver = ipopt.build(hasty(0.1), values, clearances, CONFIG)
    controls = drawn(0)
    _, states, _ = worlds.Oracle(PROBLEM, value, clearance)(START, LAST, controls)
    table, value_origin = values.window(states[-1, :2])
    distances, clearance_origin = clearances.window(START[:2])
    p = np.concatenate([START, LAST, [0.99, 1.0], value_origin, clearance_origin, table, distances])
    x = np.concatenate([states, controls], axis=1).ravel() + 1e-3 * np.random.default_rng(0).standard_normal(40)
    f = lambda x: float(solver.get_function("nlp_f")(x, p))
    g = lambda x: np.asarray(solver.get_function("nlp_g")(x, p)).ravel()
    gradient = lambda x: np.asarray(solver.get_function("nlp_grad_f")(x, p)[1]).ravel()
    jacobian = lambda x: np.asarray(solver.get_function("nlp_jac_g")(x, p)[1])
    np.testing.assert_allclose(gradient(x), worlds.finite_difference(f, x), atol=1e-5)
    weights = np.random.default_rng(1).standard_normal(len(g(x)))
    np.testing.assert_allclose(
        jacobian(x).T @ weights, worlds.finite_difference(lambda x: weights @ g(x), x), atol=1e-5
    )
    hessian = np.asarray(solver.get_function("nlp_hess_l")(x, p, 1.0, weights))
    hessian = np.triu(hessian) + np.triu(hessian, 1).T
    d = np.random.default_rng(2).standard_normal(40)
    along = lambda s: gradient(x + s * d) + jacobian(x + s * d).T @ weights
    np.testing.assert_allclose(hessian @ d, (along(1e-6) - along(-1e-6)) / 2e-6, atol=2e-3)


def test_ipopts_splines_are_the_tables_where_those_are_linear() -> None:
    value = worlds.value_of(lambda x, y, h: 20.0 + 3.0 * x - 2.0 * y)
    clearance = worlds.clearance_of(lambda x, y: 1.0 + 0.2 * x + 0.1 * y)
    values, clearances = ValueTable(value, CONFIG.reach), ClearanceTable(clearance, 1.0)
    solver, controls = ipopt.build(PROBLEM, values, clearances, CONFIG), drawn(1)
    oracle = worlds.Oracle(PROBLEM, value, clearance)
    cost, states, clear = oracle(START, LAST, controls)
    table, value_origin = values.window(states[-1, :2])
    distances, clearance_origin = clearances.window(START[:2])
    p = np.concatenate(
        [START, LAST, [oracle.discount, oracle.step_cost], value_origin, clearance_origin, table, distances]
    )
    x = np.concatenate([states, controls], axis=1).ravel()
    np.testing.assert_allclose(float(solver.get_function("nlp_f")(x, p)), cost, rtol=1e-5)
    g = np.asarray(solver.get_function("nlp_g")(x, p)).reshape(8, -1)
    np.testing.assert_allclose(g[:, :3], 0.0, atol=1e-9)
    np.testing.assert_allclose(g[:, 5:], clear, atol=1e-5)


def test_the_cost_to_go_is_continued_for_two_cells_into_collision() -> None:
    """Beyond a half-space of cost 3, two cells add the cost of driving there; further ones have the limit."""
    never = 1.0 / (1.0 - 0.99)
    value = worlds.value_of(lambda x, y, h: np.where(x < 0.0, 3.0, never))
    table = np.asarray(make_fields(value, worlds.clearance_of(lambda x, y: 1.0), PROBLEM.car).value.values)
    cell = worlds.VALUE_CELL / worlds.MOTION
    first = int(np.argmax(np.asarray(value.values)[:, 0, 0] > 3.0))
    np.testing.assert_allclose(table[:first], 3.0)
    np.testing.assert_allclose(table[first], 3.0 + cell, rtol=1e-6)
    np.testing.assert_allclose(table[first + 1], 3.0 + 2 * cell, rtol=1e-6)
    np.testing.assert_allclose(table[first + 2 :], never, rtol=1e-6)


@given(st.integers(0, 10_000))
def test_a_rollout_is_the_bicycle_step_by_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    controls = jnp.asarray(rng.uniform(-1, 1, (6, 2)) * [0.6, 0.5], jnp.float32)
    state = jnp.asarray(rng.uniform(-3, 3, 3), jnp.float32)
    rolled = objective.with_start(state, objective.rollout(PROBLEM, state, controls))
    for t in range(6):
        state = BICYCLE.mean(state, controls[t], PROBLEM.car.dt)
        np.testing.assert_allclose(rolled[t + 1, :2], state[:2], atol=2e-6)
        assert abs(np.exp(1j * float(rolled[t + 1, 2])) - np.exp(1j * float(state[2]))) < 2e-6


@given(st.integers(0, 10_000))
def test_controls_are_projected_onto_limits_and_rates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    last = rng.uniform(-1, 1, 2) * PROBLEM.car.limits
    controls = rng.uniform(-3, 3, (8, 2)) * PROBLEM.car.limits
    kept = objective.within_rates(PROBLEM, jnp.asarray(last), jnp.asarray(controls))
    assert (np.abs(kept) <= PROBLEM.car.limits + 1e-6).all()
    assert (np.abs(np.diff(kept, axis=0, prepend=last[None])) <= PROBLEM.rates + 1e-6).all()
    np.testing.assert_allclose(objective.within_rates(PROBLEM, jnp.asarray(last), kept), kept, atol=1e-6)


@given(st.integers(1, 4), st.integers(1, 8), st.integers(0, 10_000))
def test_the_discs_cover_the_edge_of_the_footprint(rows: int, columns: int, seed: int) -> None:
    car, rng = Car(), np.random.default_rng(seed)
    corners = car.corners(np.zeros(3))
    side, along = rng.integers(4, size=50), rng.uniform(size=(50, 1))
    edge = corners[side] + along * (corners[(side + 1) % 4] - corners[side])
    centres, radius = cover(car, rows, columns)
    distance = np.linalg.norm(edge[:, None] - centres, axis=-1).min(axis=1)
    assert (distance <= radius + 1e-12).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *[("horizon", 1), ("margin", -0.1), ("comfort", 0.005), ("discs", (0, 3)), ("deadline", 0.0), ("seed", -1)],
        *[("effort", float("nan")), ("speed_rate", 0.0), ("tolerance", "small")],
    ],
)
def test_a_bad_configuration_is_named(field: str, value: object) -> None:
    with pytest.raises(InputError, match=field):
        MpcConfig(**{field: value})
