"""Hold weighted particles as a belief: ``q(z) = sum_i w_i delta(z - z_i)``."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.inference.particles.weights import effective_number, normalised, systematic
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import Manifold

PARTICLE_MEAN_STEPS = 5  # iterations of a mean on the manifold: of particles within a radian of each other it is exact


class ParticleBelief(eqx.Module):
    """Hold particles and their weights.

    A set of points has no density: :meth:`log_prob` and :meth:`entropy` are those of :meth:`gaussian`, which is all
    that DVBF-LM keeps of a step's particles.

    Attributes:
        states: of the manifold, a pytree with leading axis ``n``.
        log_weight: up to a constant.
        manifold: the space of the states.
    """

    states: Any
    log_weight: Float[Array, "n"]
    manifold: Manifold = eqx.field(static=True)

    @classmethod
    def of(cls, states: Any, manifold: Manifold) -> "ParticleBelief":
        """Return equally weighted particles."""
        return cls(states, jnp.zeros(len(jax.tree.leaves(states)[0])), manifold)

    @property
    def weight(self) -> Float[Array, "n"]:
        """Return the weights; their sum is 1."""
        return jnp.exp(normalised(self.log_weight))

    @property
    def effective(self) -> Float[Array, ""]:
        """Return the number of particles that count."""
        return effective_number(self.log_weight)

    @property
    def mean(self) -> Any:
        """Return the state about which the weighted errors vanish, from the likeliest particle on."""
        mean = jax.tree.map(lambda leaf: leaf[jnp.argmax(self.log_weight)], self.states)
        for _ in range(PARTICLE_MEAN_STEPS):
            mean = self.manifold.perturb(mean, self.weight @ self.manifold.error(mean, self.states))
        return mean

    def gaussian(self) -> GaussianBelief:
        """Return the Gaussian with the same mean and covariance."""
        mean = self.mean
        xi = self.manifold.error(mean, self.states)
        return GaussianBelief(mean, (self.weight[:, None] * xi).T @ xi, self.manifold)

    def resampled(self, key: PRNGKeyArray) -> "ParticleBelief":
        """Return as many particles of equal weight, drawn systematically."""
        chosen = systematic(key, self.log_weight, len(self.log_weight))
        return ParticleBelief.of(jax.tree.map(lambda leaf: leaf[chosen], self.states), self.manifold)

    def sample(self, key: PRNGKeyArray, samples: int) -> Any:
        """Draw states of the particles, with replacement."""
        chosen = jax.random.categorical(key, normalised(self.log_weight), shape=(samples,))
        return jax.tree.map(lambda leaf: leaf[chosen], self.states)

    def log_prob(self, state: Any) -> Array:
        """Return the log density of :meth:`gaussian`; NaN where the particles do not span the space."""
        return self.gaussian().log_prob(state)

    def entropy(self) -> Array:
        """Return the entropy of :meth:`gaussian`, nats."""
        return self.gaussian().entropy()
