"""Propose control sequences to start from: systematic ones and random ones.

    u = within_rates(limits * a_k(t)),   k(t) the segment of step t

Constant arcs, manoeuvres of up to three arcs that change at random times (forward and back, straight and at full lock),
the last plan one step later, and that plan with smooth noise.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.planning.mpc.objective import shifted, within_rates
from vssm_gym.planning.mpc.problem import MpcProblem

SEGMENTS = 3  # arcs of a manoeuvre: forward, back and forward again
KNOTS = 6  # of smooth noise over the horizon
NOISE = (0.3, 0.5)  # its std, shares of the limits (speed, steering)
STEERING = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the constant arcs, shares of the limit
SPEEDS = (-1.0, -0.4, 0.4, 1.0)
FIXED = 2 + len(STEERING) * len(SPEEDS)  # the shifted plan, standing still, the constant arcs


def smooth_basis(horizon: int, knots: int = KNOTS) -> np.ndarray:
    """Return the linear interpolation of evenly spaced knots, ``(horizon, knots)`` float64; rows sum to one."""
    place = np.linspace(0.0, knots - 1.0, horizon)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(knots)))


def arcs(horizon: int) -> np.ndarray:
    """Return standing still, then every constant arc, shares of the limits, ``(1 + arcs, horizon, 2)`` float64."""
    shares = [(0.0, 0.0), *((speed, steering) for speed in SPEEDS for steering in STEERING)]
    return np.repeat(np.array(shares)[:, None], horizon, axis=1)


def manoeuvres(key: PRNGKeyArray, count: int, horizon: int) -> Float[Array, "count horizon 2"]:
    """Draw ``count`` sequences of :data:`SEGMENTS` arcs, shares of the limits; a third of them at the limit."""
    of_share, of_switch = jax.random.split(key)
    shares = jnp.clip(1.5 * jax.random.uniform(of_share, (count, SEGMENTS, 2), minval=-1.0), -1.0, 1.0)
    switches = jax.random.uniform(of_switch, (count, SEGMENTS - 1)) * horizon
    segment = jnp.sum(jnp.arange(horizon)[None, :, None] >= switches[:, None, :], axis=-1)
    return jnp.take_along_axis(shares, segment[..., None], axis=1)


def perturbed(
    problem: MpcProblem,
    key: PRNGKeyArray,
    last: Float[Array, "2"],
    plan: Float[Array, "horizon 2"],
    count: int,
    std: Float[Array, "2"],
) -> Float[Array, "count horizon 2"]:
    """Perturb ``plan`` by smooth noise of ``std`` (shares of the limits), within limits and rates."""
    knots = jax.random.normal(key, (count, KNOTS, 2), plan.dtype) * std
    noise = jnp.einsum("tk,nkc->ntc", jnp.asarray(smooth_basis(problem.config.horizon), plan.dtype), knots)
    return within_rates(problem, last, plan + jnp.asarray(problem.car.limits, plan.dtype) * noise)


def propose(
    problem: MpcProblem, key: PRNGKeyArray, last: Float[Array, "2"], plan: Float[Array, "horizon 2"], count: int
) -> Float[Array, "count horizon 2"]:
    """Propose ``count`` candidates within limits and rates: the shifted plan, standing still, then all others."""
    horizon, limits = problem.config.horizon, jnp.asarray(problem.car.limits, plan.dtype)
    of_manoeuvres, of_noise = jax.random.split(key)
    near = (count - FIXED) // 2
    far = manoeuvres(of_manoeuvres, count - FIXED - near, horizon)
    warm = shifted(plan)
    drawn = limits * jnp.concatenate([jnp.asarray(arcs(horizon), plan.dtype), far])
    noisy = perturbed(problem, of_noise, last, warm, near, jnp.asarray(NOISE, plan.dtype))
    return jnp.concatenate([within_rates(problem, last, jnp.concatenate([warm[None], drawn])), noisy])
