"""Estimate entropy and mutual information from samples alone, by the distances to nearest neighbours (eq. P44).

    H(X) = psi(n) - psi(k) + log V_d + d mean_i log r_i,    r_i the distance of sample i to its k-th nearest other one
    I(M; X) = H(X) - mean_m H(X | M = m)

What is predicted needs no density and no dimension of its own: samples of the generative model are enough (DVBF-LM).
The estimate has a bias that grows with the dimension and falls with the number of samples; of two entropies with the
same numbers most of it cancels.
"""

import jax
import jax.numpy as jnp
from jax.scipy.special import digamma, gammaln
from jaxtyping import Array, Float, Int

from vssm_gym.errors import InputError

COMPARED_TOGETHER = 16  # samples whose distances to all others are in memory at once
EQUAL_WITHIN = 1e-10  # of samples that are equal, whose entropy would be minus infinity


def knn_entropy(samples: Float[Array, "n d"], k: int = 3) -> Float[Array, ""]:
    """Estimate the differential entropy of a distribution, nats (Kozachenko and Leonenko, 1987; Euclidean).

    Args:
        samples: independent draws.
        k: neighbour whose distance is taken: more have less variance and more bias.

    Raises:
        InputError: not more samples than neighbours.
    """
    n, d = samples.shape
    if not 1 <= k < n:
        raise InputError("knn_entropy", "k", f"between 1 and {n - 1}, one fewer than the samples; found {k}")

    def to_neighbour(i: Int[Array, ""]) -> Float[Array, ""]:
        """Return the squared distance; by differences, since that of squares loses those of near neighbours."""
        squares = jnp.sum((samples - samples[i]) ** 2, axis=1)
        return -jax.lax.top_k(-squares.at[i].set(jnp.inf), k)[0][-1]

    nearest = jax.lax.map(to_neighbour, jnp.arange(n), batch_size=COMPARED_TOGETHER)
    log_distance = 0.5 * jnp.log(jnp.maximum(nearest, EQUAL_WITHIN**2))
    log_ball = 0.5 * d * jnp.log(jnp.pi) - gammaln(0.5 * d + 1.0)
    return digamma(jnp.float32(n)) - digamma(jnp.float32(k)) + log_ball + d * jnp.mean(log_distance)


def knn_information(
    marginal: Float[Array, "n d"], conditional: Float[Array, "maps n d"], k: int = 3
) -> Float[Array, ""]:
    """Estimate ``I(M; X)``, nats.

    Args:
        marginal: draws of ``X``, each under a map of its own.
        conditional: draws of ``X`` under each of several maps.
        k: neighbour whose distance is taken.

    Raises:
        InputError: not as many draws of each conditional as of the marginal, whose biases would differ.
    """
    if conditional.shape[1:] != marginal.shape:
        expected = f"{marginal.shape} draws under each map, as of the marginal; found {conditional.shape[1:]}"
        raise InputError("knn_information", "conditional", expected)
    return knn_entropy(marginal, k) - jnp.mean(jax.vmap(lambda samples: knn_entropy(samples, k))(conditional))
