"""Select one of several plans by the same rule for every solver (eq. P32).

u = argmin { C(u_k) : max_i max(0, m - d_i(u_k) + r) <= tolerance },  else the plan with the least violation
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.planning.mpc.fields import Fields
from vssm_gym.planning.mpc.objective import evaluate, footprint_clearance, with_start
from vssm_gym.planning.mpc.problem import MpcProblem, MpcResult, MpcStatus
from vssm_gym.planning.mpc.ranking import shortfall


class Selection(NamedTuple):
    """Hold the chosen plan, on the device."""

    controls: Float[Array, "time 2"]
    states: Float[Array, "steps 3"]  # the start first
    cost: Array  # step costs
    violation: Array  # m
    clearance_min: Array  # m
    start_clearance: Array  # m
    chosen: Array  # which of the plans it is


def select(
    problem: MpcProblem,
    fields: Fields,
    state: Float[Array, "3"],
    last: Float[Array, "2"],
    controls: Float[Array, "plans time 2"],
    own: int,
) -> Selection:
    """Select the best of ``controls``, all of them within limits and rates.

    The first ``own`` are the solver's, the others what it started from: those must be cheaper by ``MpcConfig.cheaper``.
    """
    plans = evaluate(problem, fields, state, last, controls)
    violation = shortfall(problem, fields, state, plans)
    feasible = violation <= problem.config.tolerance
    handicap = jnp.where(jnp.arange(controls.shape[0]) < own, 0.0, problem.config.cheaper)
    cheapest = jnp.argmin(jnp.where(feasible, plans.cost + handicap, jnp.inf))
    index = jnp.where(jnp.any(feasible), cheapest, jnp.argmin(violation))
    return Selection(
        controls[index],
        with_start(state, plans.states[index]),
        plans.cost[index],
        violation[index],
        jnp.min(plans.clearance[index]),
        jnp.min(footprint_clearance(problem, fields, state)),
        index,
    )


def to_result(
    problem: MpcProblem,
    selection: Selection,
    converged: bool,
    seconds: float,
    iterations: int,
    step: int,
    multipliers: tuple[np.ndarray, ...] = (),
) -> MpcResult:
    """Return a selection as a result on the host; a late one has the status LATE for every plan."""
    violation = float(selection.violation)
    if float(selection.start_clearance) < -problem.config.tolerance:
        status = MpcStatus.BLOCKED
    elif violation > problem.config.tolerance:
        status = MpcStatus.INFEASIBLE
    else:
        status = MpcStatus.SOLVED if converged else MpcStatus.ACCEPTABLE
    return MpcResult(
        status,
        np.asarray(selection.controls, np.float64),
        np.asarray(selection.states, np.float64),
        float(selection.cost),
        violation,
        float(selection.clearance_min),
        seconds,
        iterations,
        step,
        multipliers,
    ).within_deadline(problem.config.deadline)
