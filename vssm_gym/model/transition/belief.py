"""Represent beliefs over a state: ``q(z)`` with a mean, samples and a density; usually a Gaussian in the tangent."""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.transition.manifold import Manifold


@runtime_checkable
class Belief(Protocol):
    """Describe a distribution ``q(z)``, which need not be Gaussian."""

    @property
    def mean(self) -> Any:
        """Return a central state of the belief."""

    def sample(self, key: PRNGKeyArray, samples: int) -> Any:
        """Draw ``z ~ q(z)``: a pytree of states with leading axis ``samples``."""

    def log_prob(self, state: Any) -> Array:
        """Return ``log q(z)`` of states, with respect to the volume of state space."""

    def entropy(self) -> Array:
        """Return the entropy in nats."""


class GaussianBelief(eqx.Module):
    """``z = perturb(mean, xi)``, ``xi ~ N(0, covariance)``: a Gaussian in the tangent at the mean (eq. M15).

    The errors ``xi`` are forward, left (m) and turn (rad) of a robot on the floor; of a body in space translation (m),
    rotation (rad), both in the body frame, linear velocity (m/s) and angular velocity (rad/s), both in the world frame.

    Attributes:
        mean: a state of the manifold: ``(3,)`` x, y (m), heading (rad), or a pose ``(4, 4)`` with velocity ``(6,)``.
        covariance: of ``xi``.
        manifold: the space of the states.
    """

    mean: Any
    covariance: Float[Array, "n n"]
    manifold: Manifold = eqx.field(static=True)

    def sample(self, key: PRNGKeyArray, samples: int) -> Any:
        """Draw ``z ~ q(z)``; the covariance may be singular (a known start).

        Args:
            key: random key.
            samples: number of draws.

        Returns:
            States of the manifold with leading axis ``samples``.
        """
        variances, axes = jnp.linalg.eigh(self.covariance)
        root = axes * jnp.sqrt(jnp.maximum(variances, 0.0))
        return self.manifold.perturb(self.mean, jax.random.normal(key, (samples, root.shape[0])) @ root.T)

    def log_prob(self, state: Any) -> Float[Array, "*batch"]:
        """``log N(xi; 0, covariance) - log |det Jr(xi)|``, ``xi`` the error of the state about the mean.

        Args:
            state: of the manifold; leading batch axes.

        Returns:
            Log densities; NaN where the covariance is not positive definite.
        """
        xi = self.manifold.error(self.mean, state)
        return normal_log_prob(xi, self.covariance) - self.manifold.log_volume(xi)

    def entropy(self) -> Float[Array, ""]:
        """``1/2 log det(2 pi e covariance)``, nats: the entropy of the errors ``xi``; -inf of a known state."""
        n = self.covariance.shape[0]
        variances = jnp.linalg.eigvalsh(self.covariance)
        return 0.5 * (n * jnp.log(2.0 * jnp.pi * jnp.e) + jnp.sum(jnp.log(jnp.maximum(variances, 0.0))))


def normal_log_prob(xi: Float[Array, "*batch n"], covariance: Float[Array, "*shared n n"]) -> Float[Array, "*batch"]:
    """``log N(xi; 0, covariance)``, one covariance for all or one each; NaN where it is not positive definite."""
    root = jnp.linalg.cholesky(covariance)
    whitener = solve_triangular(root, jnp.broadcast_to(jnp.eye(xi.shape[-1]), root.shape), lower=True)
    white = jnp.einsum("...ij,...j->...i", whitener, xi)
    log_det = jnp.sum(jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    return -0.5 * jnp.sum(white**2, axis=-1) - log_det - 0.5 * xi.shape[-1] * jnp.log(2.0 * jnp.pi)
