"""Refine a plan by an augmented Lagrangian (eq. P28), with gradients through dynamics, clearances and cost-to-go.

    L(u, mu) = C(u) + 1/(2 rho) sum_i (max(0, mu_i - rho g_i(u))^2 - mu_i^2),      mu_i <- max(0, mu_i - rho g_i(u))

Inner minimisation by Adam on shares of the limits, each iterate taken back within limits and rates; outer loop over
multipliers with a growing penalty (Nocedal & Wright, Numerical Optimization, ch. 17). As in the thesis, the starting
plans come from random search.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.planning.mpc.fields import Fields
from vssm_gym.planning.mpc.objective import evaluate, within_rates
from vssm_gym.planning.mpc.problem import MpcProblem


@dataclass(frozen=True)
class RefineConfig:
    """Configure the effort of the refinement."""

    outer: int = 4  # updates of the multipliers
    inner: int = 12  # Adam's steps between them
    penalty: float = 300.0  # rho of the first round, step costs / m^2
    growth: float = 3.0  # of rho from round to round
    rate: float = 0.04  # Adam's first step, shares of the limits: a longer one destroys a nearly feasible plan
    last_rate: float = 0.004  # and its last: the steps shrink geometrically
    tightening: float = 5e-4  # m; the penalty approaches a bound from outside, so the bound is set a little inside

    @property
    def iterations(self) -> int:
        """Return the number of gradients of one refinement."""
        return self.outer * self.inner


def lagrangian(
    problem: MpcProblem,
    fields: Fields,
    state: Float[Array, "3"],
    last: Float[Array, "2"],
    least: Float[Array, ""],
    multipliers: Float[Array, "time discs"],
    penalty: Float[Array, ""],
    controls: Float[Array, "time 2"],
) -> tuple[Array, Array]:
    """Return ``L(u, mu)`` of one plan, step costs, and the multipliers that follow from it."""
    plans = evaluate(problem, fields, state, last, controls)
    raised = jnp.maximum(0.0, multipliers - penalty * (plans.clearance - least))
    return plans.cost + jnp.sum(raised**2 - multipliers**2) / (2.0 * penalty), raised


def refine(
    problem: MpcProblem,
    config: RefineConfig,
    fields: Fields,
    state: Float[Array, "3"],
    last: Float[Array, "2"],
    least: Float[Array, ""],
    controls: Float[Array, "plans time 2"],
) -> Float[Array, "plans time 2"]:
    """Return local minima near ``controls``, within limits and rates; the caller checks their clearance."""
    limits = jnp.asarray(problem.car.limits, controls.dtype)
    least = least + config.tightening
    decay = (config.last_rate / config.rate) ** (1.0 / max(1, config.iterations - 1))

    def total(shares, multipliers, penalty):
        one = lambda u, mu: lagrangian(problem, fields, state, last, least, mu, penalty, limits * u)
        values, raised = jax.vmap(one)(shares, multipliers)
        return jnp.sum(values), raised

    def step(i, carry):
        shares, mean, square, multipliers, penalty = carry
        gradient, raised = jax.grad(total, has_aux=True)(shares, multipliers, penalty)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.98 * square + 0.02 * gradient**2
        direction = (mean / (1.0 - 0.9 ** (i + 1))) / (jnp.sqrt(square / (1.0 - 0.98 ** (i + 1))) + 1e-6)
        moved = shares - config.rate * decay**i * direction
        shares = within_rates(problem, last, limits * moved) / limits
        due = (i + 1) % config.inner == 0
        multipliers = jnp.where(due, raised, multipliers)
        return shares, mean, square, multipliers, jnp.where(due, config.growth * penalty, penalty)

    shares = controls / limits
    shape = (*controls.shape[:-1], len(problem.discs[0]))
    start = (shares, 0.0 * shares, 0.0 * shares, jnp.zeros(shape, controls.dtype), jnp.asarray(config.penalty))
    return limits * jax.lax.fori_loop(0, config.iterations, step, start)[0]
