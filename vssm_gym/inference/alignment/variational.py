"""Maximise the evidence lower bound of a pose over Gaussians: ``argmin_q E_q[c(xi)] - H(q)`` (eq. I68).

    Sigma^-1 = E_q[H(xi)],    mu <- mu - Sigma E_q[g(xi)],    q = N(mu, Sigma)

The stationary conditions of the bound, solved by repetition; ``g`` and ``H`` are gradient and Gauss-Newton curvature
of the cost, and expectations are means over cubature points (Barfoot, Forbes and Yoon, "Exactly sparse Gaussian
variational inference", IJRR 2020). With one point, at the mean, it is Laplace's approximation at the MAP.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

VARIATIONAL_ROUNDS = 6  # each a Gauss-Newton step whose terms are means over the belief


def variational_gaussian(
    equations: Callable[[Float[Array, "p"]], tuple[Float[Array, "p p"], Float[Array, "p"]]],
    mean: Float[Array, "p"],
    covariance: Float[Array, "p p"],
) -> tuple[Float[Array, "p"], Float[Array, "p p"]]:
    """Return mean and covariance of the best Gaussian.

    Args:
        equations: curvature and gradient of the cost, nats, at a point.
        mean: to start from, such as the MAP.
        covariance: to start from, such as Laplace's.
    """
    p = len(mean)
    points = jnp.sqrt(p) * jnp.concatenate([jnp.eye(p), -jnp.eye(p)])  # exact for cubic integrands

    def once(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        mean, covariance = carry
        H, g = jax.vmap(equations)(mean + points @ jnp.linalg.cholesky(covariance).T)
        covariance = jnp.linalg.inv(jnp.mean(H, axis=0))
        covariance = 0.5 * (covariance + covariance.T)
        return (mean - covariance @ jnp.mean(g, axis=0), covariance), None

    return jax.lax.scan(once, (mean, covariance), None, length=VARIATIONAL_ROUNDS)[0]
