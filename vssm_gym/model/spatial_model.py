"""``p(x_1:T, z_1:T, M | u) = p(M) p(z_1) prod_t p(z_t | z_t-1, u_t-1) prod_t p(x_t | z_t, M)`` (VSSM-LM).

Its joint density, and ancestral samples of the future from a belief over map and state,

    p(x_>t, z_>t, M | u_>t, D) = int p(x_>t, z_>t | u_>t, M, z_t) q(M) q(z_t) dz_t          (VSSM-LM, PRISM)

with ``q(M)`` and ``q(z_t)`` independent, as the filter keeps them: no correlation between state and map.
"""

from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import MAX_DEPTH, RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob
from vssm_gym.model.map_samples import MeasurementNoise, sample_map
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import Belief

State = Any  # a pytree: what the transition calls its state


class SpatialModel(eqx.Module):
    """Combine transition, map and camera: the generative model.

    Attributes:
        transition: how the body moves.
        m: the belief over the map: the prior ``p(M)``, or a filter's ``q(M)``.
        camera: of the images.
        T_body_cam: pose of the camera in the body frame, m.
        scales: of the emission, and its shares of outliers and of pixels without a reading.
        measurement_noise: standard deviations of one observation that the precisions of ``m`` count.
        max_depth: z-depth up to which surfaces are rendered, m.
    """

    transition: Transition
    m: VoxelMap
    camera: Camera
    T_body_cam: Float[Array, "4 4"]
    scales: EmissionScales = EmissionScales()
    measurement_noise: MeasurementNoise = MeasurementNoise()
    max_depth: Float[Array, ""] | float = MAX_DEPTH

    def image(self, m: VoxelMap, state: State) -> RGBD:
        """Render ``mu_rgbd(z, M)``, the image from a single state in a map.

        Args:
            m: the map, such as a sample of the belief.
            state: of the transition's manifold; one state.

        Returns:
            The image at the camera's size.
        """
        T_world_cam = self.transition.manifold.pose(state) @ self.T_body_cam
        return emission.render(m, T_world_cam, self.camera, self.max_depth)


class LogJoint(NamedTuple):
    """Hold the terms of ``log p(x, z, M | u)``. Compare float32 values term by term: the cells dominate the sum."""

    cells: Float[Array, ""]  # log p(M)
    start: Float[Array, ""]  # log p(z_1)
    transitions: Float[Array, "step"]  # log p(z_t | z_t-1, u_t-1)
    images: Float[Array, "time"]  # log p(x_t | z_t, M), over all pixels

    @property
    def total(self) -> Float[Array, ""]:
        """``log p(x, z, M | u)``."""
        return self.cells + self.start + self.transitions.sum() + self.images.sum()


class Rollouts(eqx.Module):
    """Hold futures drawn from the posterior predictive."""

    states: State  # a pytree of (samples, time, ...): the state after each control
    images: RGBD | None  # arrays (samples, time, height, width[, 3]): mu_rgbd, without emission noise


@jax.jit
def log_joint(
    model: SpatialModel,
    start: Belief,
    states: State,
    controls: Float[Array, "step control"],
    images: RGBD,
    M: VoxelMap,
    dt: float | Array,
) -> LogJoint:
    """``log p(x_1:T, z_1:T, M | u_1:T-1)``; differentiable in states, map values, scales and intrinsics (eq. M1).

    Args:
        model: The model; its map is the prior ``p(M)``.
        start: ``p(z_1)``.
        states: ``z_1:T``, a pytree with leading time axis.
        controls: ``u_1:T-1``.
        images: ``x_1:T``, arrays with leading time axis.
        M: A value of the map: the means of this one; its precisions are not read.
        dt: Length of a step, s.

    Returns:
        The terms. Pose densities are with respect to metres times the angle turned; those of images are with respect
        to metres of depth and to channels in [0, 1], and count every pixel, with a reading or without.
    """
    before, after = (jax.tree.map(lambda a, s=s: a[s], states) for s in (slice(None, -1), slice(1, None)))
    first = jax.tree.map(lambda a: a[0], states)

    def observed(step):
        state, image = step
        return log_prob(image, model.image(M, state), model.scales, model.max_depth).total.sum()

    return LogJoint(
        cells=log_prob_map(M, model.m),
        start=start.log_prob(first),
        transitions=model.transition.log_prob(after, before, controls, dt),
        images=jax.lax.map(observed, (states, images)),  # one image at a time: memory does not grow with time
    )


def log_prob_map(M: VoxelMap, prior: VoxelMap) -> Float[Array, ""]:
    """``log p(M) = sum_cells log N``, occupancy and three colours a cell; precisions as stored (eq. M3)."""
    occupancy = _log_normal(M.occupancy, prior.occupancy, prior.occupancy_precision)
    colour = _log_normal(M.colour, prior.colour, prior.colour_precision[:, None])
    return occupancy + colour


@partial(jax.jit, static_argnames=("samples", "images"))
def rollout(
    key: PRNGKeyArray,
    model: SpatialModel,
    belief: Belief,
    controls: Float[Array, "time control"],
    dt: float | Array,
    *,
    samples: int,
    images: Literal["none", "mean map", "sampled maps"] = "none",
) -> Rollouts:
    """Sample ancestrally: ``M ~ q(M)``, ``z ~ q(z)``, then ``z' ~ p(z' | z, u)`` and its image, control by control.

    Args:
        key: random key.
        model: transition, map belief and camera.
        belief: ``q(z_t)``, now.
        controls: one row a step, in the units of the transition.
        dt: length of a step, s.
        samples: number of futures; their states are drawn together.
        images: ``none``; ``mean map``: rendered in the map's mean; ``sampled maps``: each future in its own sample of
            the map (which needs a new empty-space index a sample). Images are rendered one after the other.

    Returns:
        The futures: ``states`` with axes ``(samples, time, ...)``, and ``images`` with axes ``(samples, time, height,
        width[, 3])``, None for ``none``. Images are the emission's means; :mod:`vssm_gym.model.predictive` adds its
        noise.
    """
    by_start, by_step, by_map = jax.random.split(key, 3)
    states = model.transition.sample_paths(by_step, belief.sample(by_start, samples), controls, dt)
    if images == "none":
        return Rollouts(states, None)

    def seen(one):
        key, path = one
        m = model.m
        if images == "sampled maps":
            m = sample_map(key, m, model.measurement_noise)
        return jax.lax.map(lambda state: model.image(m, state), path)

    return Rollouts(states, jax.lax.map(seen, (jax.random.split(by_map, samples), states)))


def _log_normal(value: Array, mean: Array, precision: Array) -> Array:
    # Separate sums: in float32 millions of equal constants would swallow the small squares
    squares = jnp.sum(precision * (value - mean) ** 2)
    logs = jnp.sum(jnp.broadcast_to(jnp.log(precision / (2.0 * jnp.pi)), value.shape))
    return 0.5 * (logs - squares)
