"""Combine linear-Gaussian factors ``p(z) = N(mu, Sigma)``, ``p(x | z) = N(A z + a, S)`` (thesis, appendix C.1).

Given both factors, :func:`joint` is ``p(z, x)``, :func:`marginal` is ``p(x)`` and :func:`invert` is ``p(z | x)``.
Given a joint Gaussian, :func:`split` is the factorisation ``p(first) p(rest | first)``; :func:`joint` inverts it.
PRISM's step is ``split`` of the predicted (pose, velocity), a new Gaussian for the pose, and ``joint``.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float


class Gaussian(eqx.Module):
    """``N(mean, covariance)``."""

    mean: Float[Array, "n"]
    covariance: Float[Array, "n n"]  # symmetric, positive semi-definite


class LinearGaussian(eqx.Module):
    """``p(x | z) = N(A z + a, covariance)``."""

    A: Float[Array, "m n"]
    a: Float[Array, "m"]
    covariance: Float[Array, "m m"]  # of x given z

    def given(self, z: Float[Array, "n"]) -> Gaussian:
        """``p(x | z)`` at a value of ``z``."""
        return Gaussian(self.A @ z + self.a, self.covariance)


def joint(p_z: Gaussian, p_x_given_z: LinearGaussian) -> Gaussian:
    """``p(z, x) = N((mu, A mu + a), [[Sigma, Sigma A^T], [A Sigma, S + A Sigma A^T]])``, z first (C.12, C.13)."""
    A = p_x_given_z.A
    cross = A @ p_z.covariance
    mean = jnp.concatenate([p_z.mean, A @ p_z.mean + p_x_given_z.a])
    covariance = jnp.block([[p_z.covariance, cross.T], [cross, p_x_given_z.covariance + cross @ A.T]])
    return Gaussian(mean, _symmetric(covariance))


def marginal(p_z: Gaussian, p_x_given_z: LinearGaussian) -> Gaussian:
    """``p(x) = N(A mu + a, S + A Sigma A^T)`` (C.10, C.11): the prediction step of a Kalman filter (eq. I5)."""
    A = p_x_given_z.A
    covariance = p_x_given_z.covariance + A @ p_z.covariance @ A.T
    return Gaussian(A @ p_z.mean + p_x_given_z.a, _symmetric(covariance))


def invert(p_z: Gaussian, p_x_given_z: LinearGaussian) -> LinearGaussian:
    """``p(z | x) = N(K x + (1 - K A) mu - K a, (1 - K A) Sigma)``, ``K`` the Kalman gain (C.7 to C.9; eq. I5).

    ``p(x)`` must have full rank; ``p(x | z)`` need not, so an exact observation is allowed.
    """
    A, S = p_x_given_z.A, p_x_given_z.covariance
    cross = A @ p_z.covariance
    K = cho_solve((jnp.linalg.cholesky(S + cross @ A.T), True), cross).T
    # (1 - K A) Sigma (1 - K A)^T + K S K^T: equal to (1 - K A) Sigma, and positive semi-definite in float32 too
    B = jnp.eye(p_z.mean.shape[0], dtype=K.dtype) - K @ A
    covariance = B @ p_z.covariance @ B.T + K @ S @ K.T
    return LinearGaussian(K, p_z.mean - K @ (A @ p_z.mean + p_x_given_z.a), _symmetric(covariance))


def split(p: Gaussian, n: int) -> tuple[Gaussian, LinearGaussian]:
    """``p(first, rest) = p(first) p(rest | first)`` with ``rest | first = N(D first + e, S)``, ``D = P21 P11^-1``.

    Args:
        p: Joint Gaussian; the covariance of its first ``n`` coordinates must have full rank.
        n: How many coordinates come first.

    Returns:
        The Gaussian of the first ``n`` and the conditional of the rest. :func:`joint` of the two is ``p``.
    """
    first = Gaussian(p.mean[:n], p.covariance[:n, :n])
    D = cho_solve((jnp.linalg.cholesky(first.covariance), True), p.covariance[:n, n:]).T
    # [-D 1] P [-D 1]^T is the Schur complement P22 - D P12, with smaller rounding errors than that difference
    B = jnp.concatenate([-D, jnp.eye(D.shape[0], dtype=D.dtype)], axis=1)
    return first, LinearGaussian(D, p.mean[n:] - D @ first.mean, _symmetric(B @ p.covariance @ B.T))


def _symmetric(covariance: Array) -> Array:
    """Average a matrix with its transpose: rounding differences between the halves would grow over repeated steps."""
    return 0.5 * (covariance + covariance.T)
