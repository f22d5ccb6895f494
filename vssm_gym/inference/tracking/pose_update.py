"""Update a belief by an aligned pose: with errors by their sources (ours), or as published (PRISM, step 4)."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
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


class Gain(NamedTuple):
    """Hold what an estimator makes of errors: ``e <- (1 - K H) e + K g``."""

    K: Float[Array, "p p"]  # (kappa P^-1 + H)^-1
    kept: Float[Array, "p p"]  # 1 - K H = kappa K P^-1


def gain(covariance: Float[Array, "p p"], correlation: Float[Array, ""], curvature: Float[Array, "p p"]) -> Gain:
    """``K = L M L^T,  1 - K H = kappa L M L^-1,  M = (kappa 1 + L^T H L)^-1,  P = L L^T``: the gain (eq. I15).

    In these coordinates a direction that the image does not show keeps its prior in single precision, too.

    Args:
        covariance: P of the predicted pose.
        correlation: kappa, by which the prior counts more.
        curvature: H of the image.
    """
    one = jnp.eye(len(covariance))
    L = jnp.linalg.cholesky(covariance)
    root = jnp.linalg.cholesky(correlation * one + L.T @ curvature @ L)
    left = solve_triangular(root, L.T, lower=True)
    right = solve_triangular(root, solve_triangular(L, one, lower=True), lower=True)
    return Gain(left.T @ left, correlation * left.T @ right)


def propagated(
    carried: Considered, predicted: GaussianBelief, moved: Float[Array, "p"], made: Gain, given: Influence
) -> tuple[Gaussian, Considered]:
    """``e <- (1 - K H) e + K g``: the errors that the estimate has, by their sources (eq. I17).

    Args:
        carried: What is considered before the image.
        predicted: The belief before the image, of the whole state.
        moved: From the predicted pose to the estimate.
        made: The gain.
        given: Errors of the gradient.

    Returns:
        The step of the state with its covariance, and what is considered.
    """
    p, n = len(moved), predicted.covariance.shape[0]
    A, K = made.kept, made.K
    if p < n:  # velocities follow the pose
        _, rest = linear_gaussian.split(Gaussian(jnp.zeros(n), predicted.covariance), p)
        A = jnp.block([[A, jnp.zeros((p, n - p))], [rest.A @ (A - jnp.eye(p)), jnp.eye(n - p)]])
        K = jnp.concatenate([K, rest.A @ K])
        moved = jnp.concatenate([moved, rest.A @ moved])
    covariance, considered = carried.correct(predicted.covariance, A, K, given)
    return Gaussian(moved, covariance), considered


def surprise(moved: Float[Array, "p"], predicted: GaussianBelief) -> Float[Array, ""]:
    """``e^T P^-1 e``: the squared size of a step away from the predicted pose, in standard deviations."""
    p = len(moved)
    return moved @ jnp.linalg.solve(predicted.covariance[:p, :p], moved)
