"""Propose control sequences to start from: systematic ones and random ones.

    u = within_rates(limits * a_k(t)),   k(t) the segment of step t

Constant arcs, manoeuvres of up to three arcs that change at random times (forward and back, straight and at full lock),
the last plan one step later, and that plan with smooth noise.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.planning.mpc.objective import shifted, within_rates
from vssm_gym.planning.mpc.problem import MpcProblem


@dataclass(frozen=True)
class ProposalConfig:
    """Configure the control sequences that solvers start from.

    Args:
        speeds: of the constant arcs, shares of the limit.
        steerings: of the constant arcs, shares of the limit.
        segments: arcs of a manoeuvre: forward, back and forward again.
        knots: of smooth noise over the horizon.
        noise: standard deviations of the noise, shares of the limits (speed, steering).
    """

    speeds: tuple[float, ...] = (-1.0, -0.4, 0.4, 1.0)
    steerings: tuple[float, ...] = (-1.0, -0.5, 0.0, 0.5, 1.0)
    segments: int = 3
    knots: int = 6
    noise: tuple[float, float] = (0.3, 0.5)

    @property
    def fixed(self) -> int:
        """Return the number of proposals that are not drawn: the shifted plan, standing still, the constant arcs."""
        return 2 + len(self.steerings) * len(self.speeds)


def smooth_basis(horizon: int, knots: int) -> np.ndarray:
    """Return the linear interpolation of evenly spaced knots, ``(horizon, knots)`` float64; rows sum to one."""
    place = np.linspace(0.0, knots - 1.0, horizon)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(knots)))


def arcs(config: ProposalConfig, horizon: int) -> np.ndarray:
    """Return standing still, then every constant arc, shares of the limits, ``(1 + arcs, horizon, 2)`` float64."""
    shares = [(0.0, 0.0), *((speed, steering) for speed in config.speeds for steering in config.steerings)]
    return np.repeat(np.array(shares)[:, None], horizon, axis=1)


def manoeuvres(key: PRNGKeyArray, count: int, segments: int, horizon: int) -> Float[Array, "count horizon 2"]:
    """Draw ``count`` sequences of ``segments`` arcs, shares of the limits; a third of them at the limit."""
    of_share, of_switch = jax.random.split(key)
    shares = jnp.clip(1.5 * jax.random.uniform(of_share, (count, segments, 2), minval=-1.0), -1.0, 1.0)
    switches = jax.random.uniform(of_switch, (count, segments - 1)) * horizon
    segment = jnp.sum(jnp.arange(horizon)[None, :, None] >= switches[:, None, :], axis=-1)
    return jnp.take_along_axis(shares, segment[..., None], axis=1)


def perturbed(
    problem: MpcProblem,
    config: ProposalConfig,
    key: PRNGKeyArray,
    last: Float[Array, "2"],
    plan: Float[Array, "horizon 2"],
    count: int,
    scale: Float[Array, ""] | float = 1.0,
) -> Float[Array, "count horizon 2"]:
    """Perturb ``plan`` by smooth noise of ``scale`` times its configured size, within limits and rates."""
    std = scale * jnp.asarray(config.noise, plan.dtype)
    knots = jax.random.normal(key, (count, config.knots, 2), plan.dtype) * std
    basis = smooth_basis(problem.config.horizon, config.knots)
    noise = jnp.einsum("tk,nkc->ntc", jnp.asarray(basis, plan.dtype), knots)
    return within_rates(problem, last, plan + jnp.asarray(problem.car.limits, plan.dtype) * noise)


def propose(
    problem: MpcProblem,
    config: ProposalConfig,
    key: PRNGKeyArray,
    last: Float[Array, "2"],
    plan: Float[Array, "horizon 2"],
    count: int,
) -> Float[Array, "count horizon 2"]:
    """Propose ``count`` candidates within limits and rates: the shifted plan, standing still, then all others."""
    horizon, limits = problem.config.horizon, jnp.asarray(problem.car.limits, plan.dtype)
    of_manoeuvres, of_noise = jax.random.split(key)
    near = (count - config.fixed) // 2
    far = manoeuvres(of_manoeuvres, count - config.fixed - near, config.segments, horizon)
    warm = shifted(plan)
    drawn = limits * jnp.concatenate([jnp.asarray(arcs(config, horizon), plan.dtype), far])
    noisy = perturbed(problem, config, of_noise, last, warm, near)
    return jnp.concatenate([within_rates(problem, last, jnp.concatenate([warm[None], drawn])), noisy])
