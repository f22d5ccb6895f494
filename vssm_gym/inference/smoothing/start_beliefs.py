"""Turn a posterior over a pose of any shape into Gaussians that a filter can start from, each with its share (eq. I67).

    T_k = argmax log p(x, T) among the draws left,    share_k = sum_near w_i,    w_i ~ p(x, T_i) / q(T_i)

A filter holds one Gaussian. Where a place is found, one Gaussian has all of the posterior. Where places look alike each
has its share, and where the poses form a surface, as around a ball, no Gaussian has more than a patch of it: a small
share says that a filter that starts there may start at the wrong place. A covariance of few draws would be too small:
where fewer than ``LEAST_DRAWS`` count, the Gaussian is as wide as the reach of an alignment.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.inference.smoothing.pose_flow import PoseFlow
from vssm_gym.inference.smoothing.pose_posterior import NO_WEIGHT, Likelihood, Prior, weigh
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import POSES, RIGID

START_REACH = (0.3, 0.35)  # m, rad: a filter's alignment reaches poses within both
KEPT = 8  # Gaussians
START_DRAWS = 2048  # of the posterior
LEAST_STD = 1e-3  # m, rad, added in squares: so much is a map of cells of 5 cm off at least
LEAST_DRAWS = 20  # that must count for a covariance of six numbers
START_MEAN_STEPS = 3  # iterations of a mean on the manifold


class Start(NamedTuple):
    """Hold a Gaussian that a filter can start from.

    Attributes:
        belief: over a body at rest whose velocity is not known.
        share: of the posterior that lies around it, in [0, 1].
    """

    belief: GaussianBelief
    share: float


def start_beliefs(
    key: PRNGKeyArray, q: PoseFlow, prior: Prior, likelihood: Likelihood, velocity: tuple[float, float]
) -> list[Start]:
    """Return the Gaussians of a posterior, the one with the largest share first; none if no draw has a density.

    Args:
        key: of the draws.
        q: the posterior; its draws are weighted, so that it need not be exact.
        prior: ``p(z)``.
        likelihood: of the image.
        velocity: standard deviations of the linear (m/s) and the angular (rad/s) velocity.
    """
    mean, covariance, share = _parted(*weigh(key, q, prior, likelihood, START_DRAWS))
    order = [int(k) for k in jnp.argsort(-share) if share[k] > 0.0]
    return [Start(at_rest(RIGID, mean[k], covariance[k], velocity), float(share[k])) for k in order]


@jax.jit
def _parted(
    poses: Float[Array, "samples 4 4"], log_weight: Float[Array, "samples"], log_joint: Float[Array, "samples"]
) -> tuple[Float[Array, "kept 4 4"], Float[Array, "kept 6 6"], Float[Array, "kept"]]:
    """Gather the draws around the likeliest one, then around the likeliest that is left, and so on."""

    def part(left: Array, _: None) -> tuple[Array, tuple[Array, Array, Array]]:
        mean = poses[jnp.argmax(jnp.where(left > 0.0, log_joint, -jnp.inf))]
        xi = POSES.error(mean, poses)
        away, turned = (jnp.linalg.norm(half, axis=1) for half in (xi[:, :3], xi[:, 3:]))
        near = (away < START_REACH[0]) & (turned < START_REACH[1])
        weight = jnp.where(near, left, 0.0)
        share = jnp.sum(weight)
        weight = weight / jnp.maximum(share, 1e-30)
        for _step in range(START_MEAN_STEPS):
            mean = POSES.perturb(mean, weight @ POSES.error(mean, poses))
        xi = POSES.error(mean, poses)
        covariance = (weight[:, None] * xi).T @ xi + LEAST_STD**2 * jnp.eye(6)
        wide = jnp.diag(jnp.repeat(jnp.asarray(START_REACH), 3) ** 2)
        covariance = jnp.where(jnp.sum(weight**2) * LEAST_DRAWS > 1.0, wide, covariance)
        return jnp.where(near, 0.0, left), (mean, covariance, share)

    weights = jnp.where(
        log_weight > NO_WEIGHT, jax.nn.softmax(log_weight), 0.0
    )  # zero even where no draw has a density
    _, found = jax.lax.scan(part, weights, None, length=KEPT)
    return found
