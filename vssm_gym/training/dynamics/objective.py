"""Train a learned transition for the evidence of measured poses, and for open-loop predictions of many steps.

    ELBO = E_q[sum_t log p(z^_t | z_t)] - KL(q(z_1) || p(z_1)) - E_q[sum_t KL(q(z_t | z_t-1) || p(z_t | z_t-1, u_t-1))]

``q(z_t | z_t-1)`` is the product of the transition ``p(z_t | z_t-1, u_t-1)`` and the inverse emission ``q(z_t | all)``,
both Gaussian in body axes. The evidence of one step says little about ten seconds: errors that are correlated over time
add up. So predictions without measurements are trained too, by a strictly proper score of their samples ``X, X'``,

    S = E|X_k - y_k| - 1/2 E|X_k - X'_k|

(the energy score, Gneiting and Raftery 2007), which is least where mean and spread are those of what is measured; and
by the distance between the path without noise and what is measured, from states that are a little off.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.manifold import RIGID
from vssm_gym.model.transition.with_rest import RestState
from vssm_gym.training.dynamics.inverse_emission import InverseEmission
from vssm_gym.training.dynamics.windows import Windows

ELBO_WEIGHT = 0.002  # of a nat a step: then both objectives change at a like rate
# Errors that weigh the same: a metre, half a radian, and two metres a second
PER_METRE, PER_RADIAN, PER_SPEED = 2.0, 3.0 / 2.0**0.5, 1.0
BLUR = 0.01  # of a norm at zero, where it would have no derivative
# Of a start that is not the measured state: m, rad, m/s, rad/s. The path without noise learns to recover.
START_STDS = (0.0, 0.01, 0.05, 0.05)


class Model(eqx.Module):
    """Hold all that is trained.

    Attributes:
        transition: of which the network is trained.
        inverse: the inverse emission.
        log_stds: of measured positions (m) and rotations (rad).
    """

    transition: LearnedTransition
    inverse: InverseEmission
    log_stds: Float[Array, "2"]


class Predictions(NamedTuple):
    """Hold how far open-loop predictions are from what was measured, in metres and what weighs the same."""

    score: Float[Array, ""]  # of two samples
    path: Float[Array, ""]  # without noise


def elbo(model: Model, data: Windows, key: PRNGKeyArray, dt: float | Array) -> Float[Array, ""]:
    """Return the evidence's lower bound, nats a step, by one sample of every state (eq. I51)."""
    transition, evidence = model.transition, model.inverse(model.transition, data, dt)
    size, times = transition.size, data.controls.shape[1] + 1
    time_first = lambda tree: jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), tree)
    centre, stds = time_first(evidence.centre), time_first(evidence.stds)
    measured = time_first(transition.nominal.manifold.pose(data.states))
    noise = jax.random.normal(key, stds.shape)
    at = lambda tree, k: jax.tree.map(lambda a: a[k], tree)

    z = transition.perturb_in_body_axes(at(centre, 0), stds[0] * noise[0])
    # Pose and velocities have a flat prior, whose divergence is minus the entropy; the rest has N(0, 1)
    n = stds.shape[-1] - size
    first = _divergence(at(centre, 0).rest, stds[0, :, n:], 1.0) - jnp.sum(jnp.log(stds[0, :, :n]), axis=-1)
    start = emission(model, z, measured[0]) - first

    def advance(z: RestState, now: Any) -> tuple[RestState, Array]:
        control, centre, r, pose, e = now
        step = transition.step(z, control, dt)
        wanted = transition.error_in_body_axes(step.mean, centre)
        mean, std = fused(step.stds, wanted, r)
        z = transition.perturb_in_body_axes(step.mean, mean + std * e)
        kl = _divergence(mean, std, step.stds)
        return z, emission(model, z, pose) - kl

    controls = jnp.swapaxes(data.controls, 0, 1)
    inputs = (controls, at(centre, slice(1, None)), stds[1:], measured[1:], noise[1:])
    return (start.mean() + jax.lax.scan(advance, z, inputs)[1].sum(axis=0).mean()) / times


def fused(prior_std: Array, mean: Array, std: Array) -> tuple[Array, Array]:
    """``N(0, prior_std^2) N(mean, std^2)`` of independent coordinates: mean and standard deviation of the product."""
    share = prior_std**2 / (prior_std**2 + std**2)
    return share * mean, std * jnp.sqrt(share)


def emission(model: Model, z: RestState, T_measured: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch"]:
    """``log p(z^ | z)``: Gaussian in the position and in the entries of the rotation matrix.

    ``|R - R^|^2 / 2`` is the squared angle between two rotations to second order, and is smooth at half a turn.
    """
    manifold = model.transition.nominal.manifold
    T, p = manifold.pose(z.body), manifold.twists.shape[1]
    turns = int(manifold.turns[:p].sum())
    log_position, log_rotation = model.log_stds
    off = jnp.square(T - T_measured)
    position = -0.5 * jnp.sum(off[..., :3, 3], axis=-1) * jnp.exp(-2.0 * log_position) - (p - turns) * log_position
    rotation = -0.25 * jnp.sum(off[..., :3, :3], axis=(-1, -2)) * jnp.exp(-2.0 * log_rotation) - turns * log_rotation
    return position + rotation - 0.5 * p * jnp.log(2.0 * jnp.pi)


def predictions(transition: LearnedTransition, data: Windows, key: PRNGKeyArray, dt: float | Array) -> Predictions:
    """Return the energy score of two sampled paths, and the distance of one without noise (eq. I52).

    The samples begin at the measured state with a rest drawn from its prior, the path without noise near it with a rest
    of zero. All three are one scan.

    Args:
        transition: that predicts.
        data: windows; both terms are means over their steps.
        key: of all draws.
        dt: length of a step, s.
    """
    by_start, by_rest, by_noise = jax.random.split(key, 3)
    manifold, batch = transition.nominal.manifold, len(data)
    n, r, times = len(manifold.turns), transition.size, data.controls.shape[1]
    measured = jax.tree.map(lambda a: a[:, 0], data.states)
    stds = jnp.repeat(jnp.asarray(START_STDS), 3) if manifold == RIGID else jnp.zeros(n)
    away = body_axes(manifold).to_errors(measured, jax.random.normal(by_start, (batch, n)) * stds)
    near = manifold.perturb(measured, away)
    body = jax.tree.map(lambda a, b: jnp.stack([a, b, b]), near, measured)
    rest = jax.random.normal(by_rest, (3, batch, r)).at[0].set(0.0)
    e = jax.random.normal(by_noise, (times, 3, batch, n + r)).at[:, 0].set(0.0)
    controls = jnp.swapaxes(data.controls, 0, 1)
    controls = jnp.broadcast_to(controls[:, None], (times, 3, *controls.shape[1:]))

    def advance(z: RestState, now: tuple[Array, Array]) -> tuple[RestState, Any]:
        step = transition.step(z, now[0], dt)
        z = transition.perturb_in_body_axes(step.mean, step.stds * now[1])
        return z, z.body

    paths = jax.lax.scan(advance, RestState(body, rest), (controls, e))[1]
    path, first, second = (jax.tree.map(lambda a: a[:, k], paths) for k in range(3))
    after = jax.tree.map(lambda a: jnp.swapaxes(a[:, 1:], 0, 1), data.states)
    off = lambda a, b: _distance(transition, a, b)
    score = 0.5 * (off(first, after) + off(second, after)) - 0.5 * off(first, second)
    return Predictions(jnp.mean(score), jnp.mean(off(path, after)))


def _distance(transition: LearnedTransition, a: Any, b: Any) -> Array:
    """Return a sum of norms: of position, of the rotation matrices, and of the linear velocity where there is one."""
    pose = transition.nominal.manifold.pose
    off = pose(a) - pose(b)
    result = PER_METRE * _norm(off[..., :3, 3]) + PER_RADIAN * _norm(off[..., :3, :3].reshape(*off.shape[:-2], 9))
    if hasattr(a, "velocity"):
        result += PER_SPEED * _norm((a.velocity - b.velocity)[..., :3])
    return result


def _norm(a: Array) -> Array:
    return jnp.sqrt(jnp.sum(a**2, axis=-1) + BLUR**2) - BLUR


def _divergence(mean: Array, std: Array, prior_std: Array | float) -> Float[Array, "*batch"]:
    """``KL(N(mean, std^2) || N(0, prior_std^2))`` of independent coordinates, their sum."""
    ratio = (std / prior_std) ** 2
    return 0.5 * jnp.sum(ratio + (mean / prior_std) ** 2 - 1.0 - jnp.log(ratio), axis=-1)
