"""``y = A x + B h_n``, ``h_k+1 = h_k + relu(W_k h_k + b_k)``: a network with residual layers and a linear path."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class ResidualNetwork(eqx.Module):
    """Map inputs to outputs; a new one is zero everywhere, so that what it corrects begins uncorrected.

    Attributes:
        enter: of the inputs to the hidden layer.
        layers: weights and offsets of the residual layers, stacked.
        leave: of the hidden layer to the outputs.
        linear: of the inputs to the outputs, directly.
        offset: of the outputs.
    """

    enter: Float[Array, "inputs width"]
    layers: tuple[Float[Array, "depth width width"], Float[Array, "depth width"]]
    leave: Float[Array, "width outputs"]
    linear: Float[Array, "inputs outputs"]
    offset: Float[Array, "outputs"]

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Return ``y``."""
        h = jax.nn.relu(x @ self.enter)
        for k in range(self.layers[0].shape[0]):
            h = h + jax.nn.relu(h @ self.layers[0][k] + self.layers[1][k])
        return h @ self.leave + x @ self.linear + self.offset


def new_network(key: PRNGKeyArray, inputs: int, outputs: int, width: int, depth: int) -> ResidualNetwork:
    """Draw a network whose output is zero.

    Args:
        key: random key of the hidden weights.
        inputs: number of inputs.
        outputs: number of outputs.
        width: of the hidden layers.
        depth: number of residual layers.
    """
    by_enter, by_layers = jax.random.split(key)
    enter = jax.random.normal(by_enter, (inputs, width)) * jnp.sqrt(2.0 / max(inputs, 1))
    # Each layer adds to the variance of the hidden state: a depth-th of it keeps the sum of all bounded.
    layers = jax.random.normal(by_layers, (depth, width, width)) * jnp.sqrt(2.0 / (width * max(depth, 1)))
    return ResidualNetwork(
        enter,
        (layers, jnp.zeros((depth, width))),
        jnp.zeros((width, outputs)),
        jnp.zeros((inputs, outputs)),
        jnp.zeros(outputs),
    )
