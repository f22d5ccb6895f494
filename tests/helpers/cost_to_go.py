"""Make a cost-to-go whose values are known between its poses."""

import jax.numpy as jnp
import numpy as np

from vssm_gym.planning.value_iteration.cost_to_go import CostToGo


def linear_cost() -> CostToGo:
    """Return a cost-to-go that is linear in the pose, up to heading ``pi`` and from there back."""
    i, j, k = np.meshgrid(np.arange(6), np.arange(5), np.arange(8), indexing="ij")
    return CostToGo(
        values=jnp.asarray(1.0 * i + 2.0 * j + 3.0 * np.abs(k - 4), jnp.float32),
        origin=jnp.array([1.0, -1.0]),
        resolution=jnp.float32(0.5),
        gamma=0.99,
        motion_length=0.1,
    )
