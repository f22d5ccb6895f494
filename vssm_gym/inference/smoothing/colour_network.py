"""``rgb = f(p)``: a network that paints the whole space, the published alternative to a colour in each cell (VSSM-LM).

    x = (p - centre) / reach,    h_0 = softsign(W x),    h_k+1 = h_k + softsign(W_k h_k + b_k),    f = 1/2 + V h + c

Its weights are point estimates: they have no divergence from a prior, and nothing says how certain a colour is. It sees
nothing of the cells, so that unseen surfaces have colours too, those of what is near. A cell holds finer texture, costs
less and states its uncertainty, which is why the grid is the default.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.maps.block_table import stored_rows
from vssm_gym.maps.cell_centres import cell_centres
from vssm_gym.maps.voxel_map import VoxelMap

NETWORK_WIDTH, NETWORK_LAYERS = 256, 5  # VSSM-LM
UNPAINTED = 0.5  # of all channels, before anything is learned


class ColourNetwork(eqx.Module):
    """Map points of the world to colours.

    Attributes:
        centre: of the grid, m.
        reach: half of the grid's longest edge, m.
        enter: of the point to the hidden layer.
        layers: weights and offsets of the residual layers, stacked.
        leave: of the hidden layer to the channels.
        offset: of the channels.
    """

    centre: Float[Array, "3"]
    reach: Float[Array, ""]
    enter: Float[Array, "3 width"]
    layers: tuple[Float[Array, "depth width width"], Float[Array, "depth width"]]
    leave: Float[Array, "width 3"]
    offset: Float[Array, "3"]

    @classmethod
    def grey(
        cls, key: PRNGKeyArray, m: VoxelMap, width: int = NETWORK_WIDTH, layers: int = NETWORK_LAYERS
    ) -> "ColourNetwork":
        """Return a network that paints all of a grid grey.

        Args:
            key: random key of the hidden weights.
            m: whose extent the inputs are measured by.
            width: of the hidden layers.
            layers: number of residual layers.
        """
        by_enter, by_layers = jax.random.split(key)
        half = 0.5 * m.voxel_size * (jnp.asarray(m.shape) - 1)
        # Both are measured, not learned: their gradient is stopped where they are read.
        return cls(
            m.origin + half,
            jnp.max(half),
            2.0 * jax.random.normal(by_enter, (3, width)),
            (
                jax.random.normal(by_layers, (layers, width, width)) * jnp.sqrt(2.0 / (width * layers)),
                jnp.zeros((layers, width)),
            ),
            jnp.zeros((width, 3)),
            jnp.full(3, UNPAINTED),
        )

    def __call__(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Return the colours of points (m): RGB, not limited to [0, 1]."""
        centre, reach = jax.lax.stop_gradient((self.centre, self.reach))
        h = jax.nn.soft_sign(((p_world - centre) / reach) @ self.enter)

        def layer(h: Array, of: tuple[Array, Array]) -> tuple[Array, None]:
            return h + jax.nn.soft_sign(h @ of[0] + of[1]), None

        h, _ = jax.lax.scan(layer, h, self.layers)
        return h @ self.leave + self.offset

    def painted(self, m: VoxelMap) -> VoxelMap:
        """Return a map whose stored cells have the network's colours, to be rendered as any other."""
        stored = np.asarray(stored_rows(m.occupancy.shape[0], m.table))[:, None] & np.ones(m.occupancy.shape, bool)
        colour = np.moveaxis(np.asarray(m.colour), 1, 2).copy()
        colour[stored] = np.clip(np.asarray(self(jnp.asarray(cell_centres(m, stored), jnp.float32))), 0.0, 1.0)
        return eqx.tree_at(lambda m: m.colour, m, jnp.asarray(np.moveaxis(colour, 2, 1)))
