"""Update a belief by an aligned pose: with errors by their sources (ours), or as published (PRISM, step 4)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.inference import linear_gaussian
from vssm_gym.inference.alignment.surface_error import Influence
from vssm_gym.inference.linear_gaussian import Gaussian
from vssm_gym.inference.tracking.error_covariance import Considered
from vssm_gym.model.transition.belief import GaussianBelief


def published(
    before: Float[Array, "p p"],
    predicted: GaussianBelief,
    moved: Float[Array, "p"],
    precision: Float[Array, "p p"],
    information: Float[Array, "p p"],
    smoothing: float,
) -> tuple[Gaussian, Float[Array, "p p"], Float[Array, "p p"]]:
    """``Sigma^-1 = 2 J^T J + P^-1``, averaged over time: the belief, the covariance of this pose, and the average.

    Args:
        before: The average up to here; 0: there is none.
        predicted: P, of the whole state.
        moved: From the predicted pose to the estimate.
        precision: P^-1 of the pose.
        information: J^T J.
        smoothing: Share of the average that is kept.
    """
    p = len(moved)
    laplace = jnp.linalg.inv(2.0 * information + precision)
    kept = smoothing * (jnp.trace(before) > 0.0)
    smoothed = kept * before + (1.0 - kept) * laplace
    both = Gaussian(moved, smoothed)
    if p < predicted.covariance.shape[0]:
        _, rest_given_pose = linear_gaussian.split(
            Gaussian(jnp.zeros_like(predicted.covariance[0]), predicted.covariance), p
        )
        both = linear_gaussian.joint(both, rest_given_pose)
    return both, laplace, smoothed


def propagated(
    carried: Considered,
    predicted: GaussianBelief,
    moved: Float[Array, "p"],
    precision: Float[Array, "p p"],
    given: Influence,
) -> tuple[Gaussian, Float[Array, "p p"], Considered]:
    """``e <- (1 - K H) e + K g``, ``K = (P^-1 + H)^-1``: the errors that the estimate has, by their sources (eq. I15).

    Returns:
        The step of the state with its covariance, the covariance of the pose if pixels had independent errors, and
        what is considered.
    """
    p, n = len(moved), predicted.covariance.shape[0]
    laplace = jnp.linalg.inv(given.curvature + precision)
    K = laplace
    if p < n:
        _, rest = linear_gaussian.split(Gaussian(jnp.zeros(n), predicted.covariance), p)
        K = jnp.concatenate([laplace, rest.A @ laplace])
        moved = jnp.concatenate([moved, rest.A @ moved])
    A = jnp.eye(n) - jnp.pad(K @ given.curvature, ((0, 0), (0, n - p)))
    covariance, considered = carried.correct(predicted.covariance, A, K, given)
    return Gaussian(moved, covariance), laplace, considered


def surprise(moved: Float[Array, "p"], predicted: GaussianBelief) -> Float[Array, ""]:
    """``e^T P^-1 e``: the squared size of a step away from the predicted pose, in standard deviations."""
    p = len(moved)
    return moved @ jnp.linalg.solve(predicted.covariance[:p, :p], moved)
