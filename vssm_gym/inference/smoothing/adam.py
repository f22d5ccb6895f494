"""Maximise the evidence lower bound by Adam, the published solver of the variational smoother (VSSM-LM, section 4).

Each step draws a chunk of consecutive time steps and pixels of their images, estimates the bound and climbs it by Adam.
States and occupancies have no momentum. Positive numbers are learned by their logarithms.
:mod:`vssm_gym.inference.smoothing.gauss_newton` finds poses faster; this solver learns all of ``q`` and the emission.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.inference.smoothing.elbo import VariationalPosterior, draw_batch, elbo
from vssm_gym.inference.smoothing.parameters import Parameters
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.spatial_model import SpatialModel, State
from vssm_gym.model.transition.belief import Belief

GROUPS = {  # of the fields of Parameters: what has one rate
    "states": "states",
    "occupancy": "occupancy",
    "log_occupancy_std": "occupancy",
    "colour": "colour",
    "log_colour_std": "colour",
    "network": "colour",
    "log_scales": "emission",
    "intrinsics": "intrinsics",
}


@dataclass(frozen=True)
class ElboAdamConfig:
    """Configure effort and rates, by default as published.

    Args:
        steps: gradient steps.
        chunks: of consecutive time steps, drawn a gradient step.
        length: time steps of a chunk.
        pixels: drawn of each image.
        samples: trajectories drawn a gradient step.
        states_rate: of means (m, rad) and log standard deviations of states.
        occupancy_rate: of means (m) and log standard deviations of cells.
        colour_rate: the same of colours; of the weights of a network of colours.
        emission_rate: of the log scales of the emission.
        intrinsics_rate: pixels, of focal lengths and principal point, which are point estimates; 0: they stay.
        reported: gradient steps between reports, over which a cost is averaged.
    """

    steps: int = 5000
    chunks: int = 1
    length: int = 5
    pixels: int = 200
    samples: int = 1
    states_rate: float = 0.001
    occupancy_rate: float = 0.05
    colour_rate: float = 0.001
    emission_rate: float = 0.001
    intrinsics_rate: float = 0.0
    reported: int = 100


class Maximised(NamedTuple):
    """Hold ``q(z_1:T)`` as :class:`~vssm_gym.inference.smoothing.gauss_newton.Smoothed` does, and all of ``q``."""

    states: State  # means, a pytree with a leading time axis
    covariance: Float[np.ndarray, "time n n"]
    costs: list[float]  # -L, nats, the mean over the gradient steps between two reports
    q: VariationalPosterior
    model: SpatialModel  # with the learned scales and intrinsics


def smooth(
    key: PRNGKeyArray,
    model: SpatialModel,
    start: Belief,
    q: VariationalPosterior,
    controls: Float[Array, "steps control"],
    images: RGBD,
    dt: Float[Array, "steps"],
    config: ElboAdamConfig = ElboAdamConfig(),
    on_report: Callable[[int, float], None] | None = None,
) -> Maximised:
    """``argmax L`` over ``q(z_1:T, M)``, the scales of the emission and, where asked, the intrinsics (eq. I59).

    Args:
        key: random key.
        model: the model; its map is the prior ``p(M)``.
        start: ``p(z_1)``.
        q: to start from: a filter's estimate with a family around it, and a map that renders something.
        controls: of each step.
        images: one for each state, arrays with a leading time axis.
        dt: length of each step, s.
        config: effort and rates.
        on_report: called with the number of gradient steps and the cost since the last call.

    Raises:
        InputError: not one image for each state.
    """
    time = len(q.states.marginals().covariance)
    if len(images.depth) != time:
        raise InputError("smooth", "images", f"{time} images, one for each state; found {len(images.depth)}")
    parameters = Parameters.of(q, model)
    moments = _optimiser(config).init(parameters)
    costs: list[float] = []
    for done in range(0, config.steps, config.reported):
        count = min(config.reported, config.steps - done)
        keys = jax.random.split(jax.random.fold_in(key, done), count)
        parameters, moments, cost = _climb(
            parameters, moments, keys, model, start, q.m, controls, images, dt, config=config
        )
        costs.append(float(cost))
        if on_report:
            on_report(done + count, costs[-1])
    found = parameters.posterior(q.m)
    found = eqx.tree_at(lambda q: q.m, found, found.m.with_occupancy(found.m.occupancy))
    mean, covariance = found.states.marginals()
    return Maximised(mean, np.asarray(covariance), costs, found, parameters.model(model))


@partial(jax.jit, static_argnames="config", donate_argnums=1)
def _climb(
    parameters: Parameters,
    moments: Any,
    keys: Array,
    model: SpatialModel,
    start: Belief,
    grid: VoxelMap,
    controls: Array,
    images: RGBD,
    dt: Array,
    *,
    config: ElboAdamConfig,
) -> tuple[Parameters, Any, Array]:
    """Make one gradient step a key; return the mean cost."""
    optimiser, time = _optimiser(config), len(images.depth)

    def cost(parameters: Parameters, key: PRNGKeyArray) -> Array:
        of_batch, of_draws = jax.random.split(key)
        learned = parameters.model(model)
        batch = draw_batch(of_batch, time, learned.camera, config.chunks, config.length, config.pixels)
        q = parameters.posterior(grid)
        return -elbo(of_draws, learned, start, q, controls, images, dt, batch, config.samples).total

    def step(carry: tuple[Parameters, Any], key: PRNGKeyArray) -> tuple[tuple[Parameters, Any], Array]:
        parameters, moments = carry
        value, gradient = jax.value_and_grad(cost)(parameters, key)
        change, moments = optimiser.update(gradient, moments)
        return (optax.apply_updates(parameters, change), moments), value

    (parameters, moments), costs = jax.lax.scan(step, (parameters, moments), keys)
    return parameters, moments, jnp.mean(costs)


def _optimiser(config: ElboAdamConfig) -> optax.GradientTransformation:
    """Return Adam by groups of parameters."""
    rates = {
        "states": optax.adam(config.states_rate, b1=0.0),
        "occupancy": optax.adam(config.occupancy_rate, b1=0.0),
        "colour": optax.adam(config.colour_rate),
        "emission": optax.adam(config.emission_rate),
        "intrinsics": optax.adam(config.intrinsics_rate),
    }
    group = lambda path, _: GROUPS[path[0].name]
    return optax.multi_transform(rates, partial(jax.tree_util.tree_map_with_path, group))
