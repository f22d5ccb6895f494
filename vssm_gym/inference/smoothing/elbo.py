"""Estimate the evidence lower bound of the variational smoother, term by term (VSSM-LM, section 4).

    log p(x_1:T | u_1:T-1) >= L = E_q[sum_t log p(x_t | z_t, M)] - KL(q(M) || p(M))
                                  - E_q[log q(z_1:T) - log p(z_1) - sum_t log p(z_t | z_t-1, u_t-1)]

for ``q(z_1:T, M) = q(z_1:T) q(M)``. Trajectories and maps are drawn, reparameterised. What costs much, the images, is
estimated from random pixels of random steps, without bias. What costs little has no noise of that kind: the map's
divergence is in closed form, and all steps of a drawn trajectory are compared with the transition.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.smoothing.colour_network import ColourNetwork
from vssm_gym.inference.smoothing.families import TrajectoryBelief
from vssm_gym.inference.smoothing.map_draw import MapDraw
from vssm_gym.maps.block_table import stored_rows
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import log_prob
from vssm_gym.model.spatial_model import SpatialModel, State
from vssm_gym.model.transition.belief import Belief


class VariationalPosterior(eqx.Module):
    """``q(z_1:T, M) = q(z_1:T) q(M)``.

    Attributes:
        states: the trajectory, of any family.
        m: the map. Its precisions are those of the cells, 1 / std^2, not numbers of observations.
        network: of colours, instead of those of the cells; None: the cells'.
    """

    states: TrajectoryBelief
    m: VoxelMap
    network: ColourNetwork | None = None


class Elbo(NamedTuple):
    """Hold the terms of the evidence lower bound, nats."""

    images: Float[Array, ""]  # E_q[sum_t log p(x_t | z_t, M)], over all pixels
    map: Float[Array, ""]  # KL(q(M) || p(M))
    states: Float[Array, ""]  # E_q[log q(z_1:T) - log p(z_1:T | u)]

    @property
    def total(self) -> Float[Array, ""]:
        """Return the bound."""
        return self.images - self.map - self.states


class Batch(NamedTuple):
    """Hold the pixels that stand for all images."""

    step: Int[Array, "steps"]
    pixels: Int[Array, "steps pixels"]  # numbers of pixels in each step's image, row by row


def draw_batch(key: PRNGKeyArray, time: int, camera: Camera, chunks: int, length: int, pixels: int) -> Batch:
    """Draw chunks of consecutive steps, and pixels of each of their images.

    Every step and every pixel is equally likely: a chunk that passes the last step goes on at the first one.

    Args:
        key: random key.
        time: number of steps.
        camera: of the images.
        chunks: drawn.
        length: steps in a chunk.
        pixels: drawn of each image, with replacement.
    """
    of_steps, of_pixels = jax.random.split(key)
    first = jax.random.randint(of_steps, (chunks, 1), 0, time)
    step = ((first + jnp.arange(length)) % time).reshape(-1)
    return Batch(step, jax.random.randint(of_pixels, (chunks * length, pixels), 0, camera.height * camera.width))


def every_pixel(time: int, camera: Camera) -> Batch:
    """Return the batch of all pixels of all images, from which the images' term has no noise but that of ``q``."""
    pixels = jnp.arange(camera.height * camera.width)
    return Batch(jnp.arange(time), jnp.broadcast_to(pixels, (time, len(pixels))))


@partial(jax.jit, static_argnames="samples")
def elbo(
    key: PRNGKeyArray,
    model: SpatialModel,
    start: Belief,
    q: VariationalPosterior,
    controls: Float[Array, "steps control"],
    images: RGBD,
    dt: Float[Array, "steps"],
    batch: Batch,
    samples: int,
) -> Elbo:
    """Return an unbiased estimate of each term, by key and batch (eqs. I53 and I58).

    Differentiable in the parameters of ``q``, in the emission scales and in the intrinsics.

    Args:
        key: of the draws from ``q``.
        model: the model; its map is the prior ``p(M)``, stored as ``q(M)`` is.
        start: ``p(z_1)``.
        q: the approximate posterior.
        controls: ``u_1:T-1``, one for each step from a state to the next.
        images: ``x_1:T``, arrays with a leading time axis.
        dt: length of each step, s.
        batch: pixels that stand for all of them.
        samples: trajectories drawn. Each of their images has a map draw of its own: the images' term is a sum over
            images, which depends on the marginals of ``q`` alone, and independent draws have the smaller variance
            (local reparameterisation; Kingma, Salimans and Welling, NeurIPS 2015).
    """
    of_states, of_maps = jax.random.split(key)
    drawn = q.states.draw(of_states, samples)
    keys = jax.random.split(of_maps, (samples, len(batch.step)))
    chosen = jax.tree.map(lambda leaf: leaf[:, batch.step], drawn.states)
    seen = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:])[_flat(batch, images)], images)
    of_image = partial(log_prob_pixels, model, q)
    of_trajectory = jax.vmap(of_image, in_axes=(0, 0, 0, 0))
    pixels = jax.vmap(of_trajectory, in_axes=(0, 0, None, None))(keys, chosen, seen, batch.pixels)
    path = log_prob_path(model, start, drawn.states, controls, dt)
    return Elbo(
        images=images.depth.size * jnp.mean(pixels),
        map=map_divergence(q.m, model.m, q.network is None),
        states=-jnp.mean(jnp.sum(drawn.entropy, axis=1) + path),
    )


def log_prob_pixels(
    model: SpatialModel,
    q: VariationalPosterior,
    key: PRNGKeyArray,
    state: State,
    image: RGBD,
    pixels: Int[Array, "pixels"],
) -> Float[Array, "pixels"]:
    """``log p(x | z, M)`` of pixels of one image, ``M ~ q(M)`` by the key.

    The search is the fixed march: the index of empty boxes is that of the mean, and a draw may have surfaces in them.
    Every surface of a draw counts as observed. The likelihood has shares of its own for surfaces that follow from the
    mean of unobserved cells; a draw has no such guesses, and a likelihood of ``M`` must not depend on ``q(M)``.

    Args:
        model: transition, camera and scales.
        q: whose map is drawn.
        key: of the map.
        state: of the body; one state.
        image: the pixels' readings, arrays with one axis of pixels.
        pixels: their numbers in the image.
    """
    T_world_cam = model.transition.manifold.pose(state) @ model.T_body_cam
    rays = emission.world_rays(T_world_cam, model.camera, pixels)
    hits = emission.trace(emission.march, MapDraw.of(key, q.m, q.network), *rays, model.max_depth)
    row = lambda a: a[None]  # an image of one row
    predicted = RGBD(row(hits.depth), row(hits.rgb), row(hits.hit), row(hits.hit))
    return log_prob(jax.tree.map(row, image), predicted, model.scales, model.max_depth).total[0]


def log_prob_path(
    model: SpatialModel,
    start: Belief,
    states: State,
    controls: Float[Array, "steps control"],
    dt: Float[Array, "steps"],
) -> Float[Array, "samples"]:
    """``log p(z_1) + sum_t log p(z_t | z_t-1, u_t-1)`` of trajectories.

    Args:
        model: its transition is used.
        start: ``p(z_1)``.
        states: a pytree with axes (samples, time, ...).
        controls: of each step.
        dt: length of each step, s.
    """
    first, before, after = (
        jax.tree.map(lambda leaf, s=s: leaf[:, s], states) for s in (0, slice(None, -1), slice(1, None))
    )

    def step(after: State, before: State, control: Array, dt: Array) -> Array:
        alike = jnp.broadcast_to(control, (jax.tree.leaves(after)[0].shape[0], *control.shape))
        return model.transition.log_prob(after, before, alike, dt)

    steps = jax.vmap(step, in_axes=(1, 1, 0, 0))(after, before, controls, dt)
    return start.log_prob(first) + jnp.sum(steps, axis=0)


def map_divergence(q: VoxelMap, prior: VoxelMap, coloured: bool = True) -> Float[Array, ""]:
    """``KL(q(M) || p(M))`` of occupancy and three colours a cell, over the stored cells (eq. I56).

    Blocks without storage are no part of the random map (:mod:`~vssm_gym.inference.smoothing.map_draw`).

    Args:
        q: the approximate posterior.
        prior: stored alike.
        coloured: whether colours are those of the cells; a network of them has no divergence.
    """
    stored = stored_rows(q.occupancy.shape[0], q.table)[:, None]
    cells = _divergence(q.occupancy, q.occupancy_precision, prior.occupancy, prior.occupancy_precision)
    if coloured:
        precisions = q.colour_precision[:, None], prior.colour_precision[:, None]
        cells = cells + jnp.sum(_divergence(q.colour, precisions[0], prior.colour, precisions[1]), axis=1)
    return jnp.sum(jnp.where(stored, cells, 0.0))


def _divergence(mean: Array, precision: Array, prior_mean: Array, prior_precision: Array) -> Array:
    """Return ``KL(N(mean, 1 / precision) || N(prior_mean, 1 / prior_precision))``."""
    ratio = prior_precision / precision
    return 0.5 * (ratio - 1.0 - jnp.log(ratio) + prior_precision * (mean - prior_mean) ** 2)


def _flat(batch: Batch, images: RGBD) -> Int[Array, "steps pixels"]:
    """Return the positions of a batch's pixels among those of all images."""
    return batch.step[:, None] * images.depth[0].size + batch.pixels
