"""Rank many candidate plans by cost and constraint violation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.planning.mpc.fields import Fields
from vssm_gym.planning.mpc.objective import Plans, evaluate, required_clearance
from vssm_gym.planning.mpc.problem import MpcProblem


def shortfall(problem: MpcProblem, fields: Fields, state: Float[Array, "3"], plans: Plans) -> Array:
    """Return ``max_ti max(0, m - d_ti + r)`` of each plan, m."""
    return jnp.maximum(0.0, required_clearance(problem, fields, state) - jnp.min(plans.clearance, axis=(-2, -1)))


def ranked(
    problem: MpcProblem,
    fields: Fields,
    state: Float[Array, "3"],
    last: Float[Array, "2"],
    controls: Float[Array, "plans time 2"],
    count: int,
) -> tuple[Float[Array, "count time 2"], Float[Array, "count"]]:
    """Return the ``count`` best by cost and shortfall, the best first, and what they were ranked by, step costs."""
    plans = evaluate(problem, fields, state, last, controls)
    short = shortfall(problem, fields, state, plans)
    score, chosen = jax.lax.top_k(-(plans.cost + problem.config.shortfall * short), count)
    return controls[chosen], -score
