"""Define the networks of PPO: a Gaussian policy ``a ~ N(mu(x), diag(sigma)^2)`` and a value ``V(x)``, two MLPs."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

HIDDEN_GAIN = math.sqrt(2.0)  # of orthogonal weights that an activation follows
FIRST_MEAN_GAIN, FIRST_VALUE_GAIN = 0.01, 1.0  # of the last layers: the first policy hardly depends on what it sees
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"tanh": jnp.tanh, "relu": jax.nn.relu}

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


class MLP(eqx.Module):
    """Compute ``h_i = f(W_i h_i-1 + b_i)`` and a linear last layer."""

    layers: tuple[eqx.nn.Linear, ...]
    activation: str = eqx.field(static=True)

    def __init__(self, widths: Sequence[int], activation: str, last_gain: float, key: PRNGKeyArray) -> None:
        layers = []
        for i, ((n, m), one) in enumerate(zip(pairwise(widths), jax.random.split(key, len(widths) - 1), strict=True)):
            gain = last_gain if i == len(widths) - 2 else HIDDEN_GAIN
            weight = jax.nn.initializers.orthogonal(gain)(one, (m, n))
            linear = eqx.nn.Linear(n, m, key=one)
            layers.append(eqx.tree_at(lambda s: (s.weight, s.bias), linear, (weight, jnp.zeros(m))))
        self.layers, self.activation = tuple(layers), activation

    def __call__(self, x: Float[Array, "n inputs"]) -> Float[Array, "n outputs"]:
        """Compute the outputs of n inputs."""
        for layer in self.layers[:-1]:
            x = ACTIVATIONS[self.activation](jax.vmap(layer)(x))
        return jax.vmap(self.layers[-1])(x)


class ActorCritic(eqx.Module):
    """Hold the policy's mean, its standard deviation, which is the same everywhere, and the value."""

    mean: MLP
    log_std: Float[Array, "actions"]
    value: MLP

    def values(self, x: Float[Array, "n inputs"]) -> Float[Array, "n"]:
        """Return the values of n inputs."""
        return self.value(x)[:, 0]

    def sample(self, x: Float[Array, "n inputs"], key: PRNGKeyArray) -> tuple[Float[Array, "n a"], Float[Array, "n"]]:
        """Draw an action for each input; return the actions and their log densities."""
        mean = self.mean(x)
        action = mean + jnp.exp(self.log_std) * jax.random.normal(key, mean.shape)
        return action, self._log_density(mean, action)

    def log_density(self, x: Float[Array, "n inputs"], action: Float[Array, "n a"]) -> Float[Array, "n"]:
        """Return the log densities of actions."""
        return self._log_density(self.mean(x), action)

    def entropy(self) -> Float[Array, ""]:
        """Return the entropy of the policy, nats."""
        return jnp.sum(self.log_std + 0.5 * math.log(2.0 * math.pi * math.e))

    def policy_layers(self) -> Layers:
        """Return ``(weight, bias)`` of each layer of the mean."""
        return tuple((np.asarray(one.weight), np.asarray(one.bias)) for one in self.mean.layers)

    def _log_density(self, mean: Float[Array, "n a"], action: Float[Array, "n a"]) -> Float[Array, "n"]:
        scaled = (action - mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * scaled**2 - self.log_std - 0.5 * math.log(2.0 * math.pi), axis=-1)


def make_network(
    inputs: int, actions: int, hidden: Sequence[int], activation: str, log_std: float, key: PRNGKeyArray
) -> ActorCritic:
    """Make the networks: orthogonal weights, biases of zero, a small last layer of the policy."""
    of_mean, of_value = jax.random.split(key)
    return ActorCritic(
        MLP((inputs, *hidden, actions), activation, FIRST_MEAN_GAIN, of_mean),
        jnp.full(actions, log_std, jnp.float32),
        MLP((inputs, *hidden, 1), activation, FIRST_VALUE_GAIN, of_value),
    )
