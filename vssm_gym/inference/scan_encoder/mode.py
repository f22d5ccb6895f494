"""``argmax_z p(x | z, M)`` of one scan among the places that were visited, from draws of the encoder on (eq. P49).

The encoder proposes; the model says how well each proposal explains the scan; the best are scattered ever more closely.
How often a drive has been somewhere says nothing about a goal: the prior bounds the search and does not weigh it. Every
round has one static shape, and a model need not be differentiable.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.scan_encoder.network import ScanEncoder
from vssm_gym.model.scan_model import ScanModel

PROPOSALS = 512  # poses of the first round
SCATTERED = 192  # of a later one
KEPT_PROPOSALS = 12  # best of a round, about which the next one scatters
NEVER_VISITED = -1e4  # nats, of a place that was not visited
BEYOND = 2.0  # nats, below the least density of a visited place: two standard deviations away from it
SCATTER = (0.02, 0.01, 0.005, 0.0025)  # m, and ten times as many rad, of each round


def pose_of(
    encoder: ScanEncoder, model: ScanModel, ranges: Float[np.ndarray, "beams"], seed: int
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the pose that explains a scan best, x, y (m), heading (rad), and the log density of the scan there, nats.

    Args:
        encoder: trained against the model.
        model: of the scans.
        ranges: measured, m; 0 where there is no reading.
        seed: of the proposals.
    """
    pose, score = _mode(encoder, model, jnp.asarray(ranges, jnp.float32), jax.random.key(seed))
    return np.asarray(pose, np.float64), float(score)


@eqx.filter_jit
def _mode(encoder: ScanEncoder, model: ScanModel, ranges: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
    q = encoder(ranges)
    drawn = q.sample(key, PROPOSALS - len(q.log_weight))
    proposals = jnp.concatenate([q.mean, drawn])
    visited = jnp.concatenate([encoder.prior.places, jnp.zeros((len(encoder.prior.places), 1))], axis=-1)
    least = jnp.min(encoder.prior.log_prob(visited)) - BEYOND

    def scored(states: Array) -> tuple[Array, Array]:
        score = model.log_prob(ranges, states)
        score = score + jnp.where(encoder.prior.log_prob(states) < least, NEVER_VISITED, 0.0)
        best = jnp.argsort(-score)[:KEPT_PROPOSALS]
        return states[best], score[best]

    def closer(carry: tuple[Array, Array], now: tuple[Array, PRNGKeyArray]) -> tuple[tuple[Array, Array], None]:
        states, _ = carry
        std, key = now
        spread = jnp.array([1.0, 1.0, 10.0]) * std
        near = jnp.repeat(states, SCATTERED // KEPT_PROPOSALS, axis=0)
        moved = near + spread * jax.random.normal(key, near.shape).at[:: SCATTERED // KEPT_PROPOSALS].set(
            0.0
        )  # each stays once
        return scored(moved.at[:, 2].set(wrap_angle(moved[:, 2]))), None

    keys = jax.random.split(jax.random.fold_in(key, 1), len(SCATTER))
    (states, score), _ = jax.lax.scan(closer, scored(proposals), (jnp.array(SCATTER), keys))
    return states[0], score[0]
