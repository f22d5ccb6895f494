"""Find the poses that explain one scan, ``argmax_z p(x | z, M)`` among the places that were visited (eq. P49).

The encoder proposes, and so does its prior, since a network may be sure and wrong; the model says how well each
proposal explains the scan. The best that lie apart are climbed from, each by itself, so that places that look alike
stay modes. How often a drive has been somewhere says nothing about a goal: the prior bounds the search and does not
weigh it. Every round has one static shape, and a model need not be differentiable.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.scan_encoder.network import ScanEncoder
from vssm_gym.model.scan_model import ScanModel

ENCODER_PROPOSALS = 512  # poses that the encoder draws
PRIOR_PROPOSALS = 3584  # poses that its prior draws
SCORED_TOGETHER = 512  # poses whose scans are predicted at once
CLIMBS = 16  # proposals that are climbed from
SCATTERED = 32  # poses about the best of a climb, in each round
MODES_APART = 0.05  # m, between the places of two modes
NEVER_VISITED = -1e4  # nats, of a place that was not visited
BEYOND = 2.0  # nats, below the least density of a visited place: two standard deviations away from it
SCATTER = (0.02, 0.01, 0.01, 0.005, 0.005, 0.0025, 0.0025, 0.00125)  # m, and ten times as many rad, of each round


class ScanModes(NamedTuple):
    """Hold poses that explain a scan, the best first; places are at least :data:`MODES_APART` from each other."""

    poses: Float[np.ndarray, "modes 3"]  # x, y (m), heading (rad)
    scores: Float[np.ndarray, "modes"]  # log density of the scan at each, nats


def modes_of(encoder: ScanEncoder, model: ScanModel, ranges: Float[np.ndarray, "beams"], seed: int) -> ScanModes:
    """Return the poses that explain a scan, the best first; at least one.

    Args:
        encoder: trained against the model.
        model: of the scans.
        ranges: measured, m; 0 where there is no reading.
        seed: of the proposals.
    """
    found = _modes(encoder, model, jnp.asarray(ranges, jnp.float32), jax.random.key(seed))
    poses, scores = (np.asarray(a, np.float64) for a in found)
    visited = np.isfinite(scores) & (scores > 0.5 * NEVER_VISITED)
    visited[0] = True
    return ScanModes(poses[visited], scores[visited])


@eqx.filter_jit
def _modes(encoder: ScanEncoder, model: ScanModel, ranges: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
    by_encoder, by_prior, by_round = jax.random.split(key, 3)
    q = encoder(ranges)
    drawn = q.sample(by_encoder, ENCODER_PROPOSALS - len(q.log_weight))
    proposals = jnp.concatenate([q.mean, drawn, encoder.prior.sample(by_prior, PRIOR_PROPOSALS)])
    visited = jnp.concatenate([encoder.prior.places, jnp.zeros((len(encoder.prior.places), 1))], axis=-1)
    least = jnp.min(encoder.prior.log_prob(visited)) - BEYOND

    def score(states: Array) -> Array:
        never = jnp.where(encoder.prior.log_prob(states) < least, NEVER_VISITED, 0.0)
        return model.log_prob(ranges, states) + never

    def climb(carry: tuple[Array, Array], now: tuple[Array, PRNGKeyArray]) -> tuple[tuple[Array, Array], None]:
        best, reached = carry
        std, key = now
        spread = jnp.array([1.0, 1.0, 10.0]) * std
        near = best[:, None] + spread * jax.random.normal(key, (CLIMBS, SCATTERED, 3))
        near = near.at[..., 2].set(wrap_angle(near[..., 2]))
        scores = score(near.reshape(-1, 3)).reshape(CLIMBS, SCATTERED)
        k = jnp.argmax(scores, axis=1)[:, None]
        there, nats = (
            jnp.take_along_axis(near, k[..., None], axis=1)[:, 0],
            jnp.take_along_axis(scores, k, axis=1)[:, 0],
        )
        better = nats > reached
        return (jnp.where(better[:, None], there, best), jnp.where(better, nats, reached)), None

    scores = jax.lax.map(score, proposals.reshape(-1, SCORED_TOGETHER, 3)).reshape(-1)
    rounds = jnp.array(SCATTER), jax.random.split(by_round, len(SCATTER))
    (poses, scores), _ = jax.lax.scan(climb, _apart(proposals, scores), rounds)
    return _apart(poses, scores)


def _apart(poses: Float[Array, "n 3"], scores: Float[Array, "n"]) -> tuple[Array, Array]:
    """Return the best pose, the best of those apart from it, and so on; -inf are the scores when none is left."""

    def choose(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        k = jnp.argmax(left)
        near = jnp.hypot(*(poses[:, :2] - poses[k, :2]).T) < MODES_APART
        return jnp.where(near, -jnp.inf, left), (poses[k], left[k])

    return jax.lax.scan(choose, scores, None, length=CLIMBS)[1]
