"""Evaluate cost and constraints of any number of plans, in JAX (eq. P24, P26).

    C(u) = sum_{t<T} gamma^t c(z_{t+1}, u_t) + gamma^T J(z_T)
    c(z, u) = min(s, J(z)) + s (h J(z) + e (v / v_max)^2 + w sum (Du / limit)^2
                                + k mean_i max(0, 1 - (d_i - r) / comfort)^2)
    g_ti(u) = d(p_i(z_t)) - r - m  >=  0

Where the cost-to-go counts a motion ``k`` times, a step counts so, too: its discount is ``gamma^n``
and its ``s`` is ``(1 - gamma^n) / (1 - gamma_J)`` with ``n = 1 + (k - 1) |v| / v_max``.

``s`` is the cost of one step in the unit of ``J``: min(s, J) charges for time until the goal region, where ``J`` is
zero, without naming the goal. A step is charged where it ends, since no control changes the pose at which it starts.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.mpc.fields import Fields
from vssm_gym.planning.mpc.problem import MpcProblem


class Plans(NamedTuple):
    """Hold evaluated plans."""

    states: Float[Array, "*batch time 3"]  # z_1 .. z_T; a heading may be wrapped or not
    cost: Float[Array, "*batch"]  # step costs
    clearance: Float[Array, "*batch time discs"]  # d - r, m


def rollout(problem: MpcProblem, state: Float[Array, "3"], controls: Float[Array, "*batch time 2"]) -> Array:
    """Return ``z_1 .. z_T``, ``(*batch, time, 3)``; headings are wrapped or not, as the transition leaves them."""
    return problem.motion.mean_path(state, controls, problem.car.dt)


def footprint_clearance(problem: MpcProblem, fields: Fields, states: Float[Array, "*batch 3"]) -> Array:
    """Return ``d(p_i(z)) - r`` of every disc of the footprint, ``(*batch, discs)``, m."""
    centres, radius = problem.discs
    x, y = jnp.asarray(centres.T, states.dtype)
    c, s = jnp.cos(states[..., 2:]), jnp.sin(states[..., 2:])
    points = jnp.stack([states[..., :1] + c * x - s * y, states[..., 1:2] + s * x + c * y], axis=-1)
    return fields.distance(points) - radius


def evaluate(
    problem: MpcProblem,
    fields: Fields,
    state: Float[Array, "3"],
    last: Float[Array, "2"],
    controls: Float[Array, "*batch time 2"],
) -> Plans:
    """Evaluate poses, cost and clearances of plans that start at ``state`` after the command ``last``."""
    config, limits = problem.config, jnp.asarray(problem.car.limits, controls.dtype)
    states = rollout(problem, state, controls)
    clearance = footprint_clearance(problem, fields, states)
    value = fields.value.at(states)
    scaled = controls / limits
    first = jnp.broadcast_to(last / limits, (*controls.shape[:-2], 1, 2))
    change = jnp.diff(jnp.concatenate([first, scaled], axis=-2), axis=-2)
    closeness = jnp.maximum(0.0, 1.0 - clearance / config.comfort)
    counted = 1.0 + (fields.value.counted(states, scaled[..., 0]) - 1.0) * jnp.abs(scaled[..., 0])
    time = fields.step_cost if fields.value.counts is None else _time(fields, counted)
    stage = jnp.minimum(value, time) + fields.step_cost * (
        config.haste * value
        + config.effort * scaled[..., 0] ** 2
        + config.smoothness * jnp.sum(change**2, axis=-1)
        + config.proximity * jnp.mean(closeness**2, axis=-1)
    )
    if fields.value.counts is None:
        weights, last_weight = fields.discount ** jnp.arange(controls.shape[-2]), fields.discount ** controls.shape[-2]
    else:
        passed = jnp.cumsum(counted, axis=-1)
        weights, last_weight = fields.discount ** (passed - counted), fields.discount ** passed[..., -1]
    total = jnp.sum(weights * stage, axis=-1) + last_weight * value[..., -1]
    return Plans(states, total, clearance)


def _time(fields: Fields, counted: Float[Array, "*batch time"]) -> Array:
    """Return the cost of a step that counts as so many, ``(*batch, time)``."""
    return fields.step_cost * (1.0 - fields.discount**counted) / (1.0 - fields.discount)


def required_clearance(problem: MpcProblem, fields: Fields, state: Float[Array, "3"]) -> Array:
    """Return ``m``: the margin, or what the present pose has where that is less, m.

    A car that noise has pushed below the margin is not stuck: it may go anywhere that is not closer still.
    """
    return jnp.minimum(jnp.min(footprint_clearance(problem, fields, state)), problem.config.margin)


def within_rates(problem: MpcProblem, last: Float[Array, "2"], controls: Float[Array, "*batch time 2"]) -> Array:
    """Move each control, one after the other, into the limits and to within a rate of the one before it."""
    limits, rates = (jnp.asarray(a, controls.dtype) for a in (problem.car.limits, problem.rates))
    before, kept = jnp.broadcast_to(last, controls[..., 0, :].shape), []
    for t in range(controls.shape[-2]):  # unrolled: 25 clips in one fused loop instead of a scan of tiny steps
        before = jnp.clip(jnp.clip(controls[..., t, :], before - rates, before + rates), -limits, limits)
        kept.append(before)
    return jnp.stack(kept, axis=-2)


def shifted(controls: Float[Array, "time 2"]) -> Float[Array, "time 2"]:
    """Return the plan one step later, its last control repeated."""
    return jnp.concatenate([controls[1:], controls[-1:]])


def with_start(state: Float[Array, "3"], states: Float[Array, "time 3"]) -> Float[Array, "steps 3"]:
    """Return ``z_0 .. z_T``, headings in [-pi, pi)."""
    every = jnp.concatenate([state[None], states])
    return every.at[:, 2].set(wrap_angle(every[:, 2]))
