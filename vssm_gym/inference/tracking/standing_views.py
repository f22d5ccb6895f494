"""Keep what a robot has seen from where it stands, and find its heading again by these views (ours).

A robot that turns in place before a bare wall sees no turn for a step or two, and none of the turns that it sees from
then on tells its heading. It does again where an image shows what an image with a known heading has shown.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.inference.filter import Rig
from vssm_gym.inference.tracking.error_covariance import Considered
from vssm_gym.inference.tracking.visual_turn import DRIVEN, STD, driven, turn_index, turned
from vssm_gym.model.transition.belief import GaussianBelief

MOST_VIEWS = 32  # views at most; the oldest is replaced
VIEWS_APART = 0.15  # rad, a new view is farther than this from every other
NEAREST_VIEWS = 8  # views nearest to the believed heading, which an image is compared with
AGREEING = 4.0 * STD  # rad, by which the headings by several views may differ


class StandingViews(eqx.Module):
    """Hold views with known headings, all from one place."""

    grey: Float[Array, "views height width"]  # luminance, of :func:`visual_turn.small_grey`
    mean: Any  # of the beliefs where they were seen: states with a leading axis of views
    covariance: Float[Array, "views d d"]
    count: Int[Array, ""]  # views that were ever kept here


def begin(belief: GaussianBelief, grey: Float[Array, "height width"]) -> StandingViews:
    """Return the views of a robot that has seen one image."""
    every = lambda value: jnp.zeros((MOST_VIEWS, *value.shape), value.dtype).at[0].set(value)
    return StandingViews(every(grey), jax.tree.map(every, belief.mean), every(belief.covariance), jnp.int32(1))


@jax.jit
def remember(views: StandingViews, belief: GaussianBelief, grey: Float[Array, "height width"]) -> StandingViews:
    """Keep an image whose heading is known, where no kept one has nearly the same; forget those of another place."""
    k, manifold = turn_index(belief.manifold), belief.manifold
    moved = jax.vmap(lambda mean: manifold.error(mean, belief.mean))(views.mean)
    kept = jnp.arange(MOST_VIEWS) < views.count
    elsewhere = jax.vmap(lambda error: driven(error, manifold))(moved) > DRIVEN
    count = jnp.where(jnp.any(kept & elsewhere), 0, views.count)
    new = (count == 0) | ~jnp.any(kept & (jnp.abs(moved[:, k]) < VIEWS_APART))
    slot = jnp.where(new, count % MOST_VIEWS, MOST_VIEWS)  # one past the end writes nothing
    put = lambda every, value: every.at[slot].set(value, mode="drop")
    mean = jax.tree.map(put, views.mean, belief.mean)
    return StandingViews(put(views.grey, grey), mean, put(views.covariance, belief.covariance), count + new)


@jax.jit
def recognised(
    belief: GaussianBelief, views: StandingViews, grey: Float[Array, "height width"], rig: Rig, considered: Considered
) -> tuple[GaussianBelief, Bool[Array, ""]]:
    """Correct a belief by the turn between an image and what was seen from the same place before (eq. I38).

    Args:
        belief: predicted, with all the turns since those views in its covariance.
        views: with known headings.
        grey: luminance of the image, of :func:`visual_turn.small_grey`.
        rig: the camera, at full size, and its place on the body.
        considered: as of :func:`visual_turn.turned`.

    Returns:
        The corrected belief, as predicted where the images do not tell; and whether they do, and agree.
    """
    k, manifold = turn_index(belief.manifold), belief.manifold
    away = jax.vmap(lambda mean: jnp.abs(manifold.error(mean, belief.mean)[k]))(views.mean)
    nearest = jnp.argsort(jnp.where(jnp.arange(MOST_VIEWS) < views.count, away, jnp.inf))[:NEAREST_VIEWS]

    def compare(index: Array) -> tuple[Array, Array, Array]:
        mean = jax.tree.map(lambda every: every[index], views.mean)
        before = GaussianBelief(mean, views.covariance[index], manifold)
        found, told = turned(belief, before, views.grey[index], grey, rig, considered)
        return manifold.error(belief.mean, found.mean), found.covariance, told & (index < views.count)

    corrections, covariances, told = jax.lax.map(compare, nearest)
    turns = corrections[:, k]
    best = jnp.argmin(jnp.where(told, covariances[:, k, k], jnp.inf))
    agree = jnp.all(~told | (jnp.abs(turns - turns[best]) <= AGREEING))
    use = jnp.any(told) & agree
    mean = manifold.perturb(belief.mean, jnp.where(use, corrections[best], 0.0))
    covariance = jnp.where(use, covariances[best], belief.covariance)
    return GaussianBelief(mean, covariance, manifold), use
