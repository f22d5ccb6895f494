"""Move a planar robot as its odometry says: the control is the measured motion, with errors that grow with it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.manifold import PLANAR


class Odometry(Transition):
    """``z' = z exp(u + e)``, ``e ~ N(0, diag(floor + share |u|)^2)`` for small errors (eq. M35).

    Controls are motions ``(forward, left, turn)`` in the body frame before the step, m, m, rad; ``dt`` plays no part.

    Attributes:
        floor: standard deviations of a step without motion: forward, left (m), turn (rad).
        share: of the distance, of the distance and of the turn, that are added to them.
    """

    floor: tuple[float, float, float]
    share: tuple[float, float, float] = (0.1, 0.1, 0.1)

    manifold = PLANAR
    controls = 3
    commanded = True

    def mean(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Return the pose that is ``control`` away from ``state``."""
        c, s = jnp.cos(state[..., 2]), jnp.sin(state[..., 2])
        x = state[..., 0] + c * control[..., 0] - s * control[..., 1]
        y = state[..., 1] + s * control[..., 0] + c * control[..., 1]
        return jnp.stack([x, y, wrap_angle(state[..., 2] + control[..., 2])], axis=-1)

    def noise_covariance(
        self, state: Float[Array, "3"], control: Float[Array, "3"], dt: float | Array
    ) -> Float[Array, "3 3"]:
        """Return the covariance in the body frame after the step."""
        distance = jnp.hypot(control[0], control[1])
        moved = jnp.stack([distance, distance, jnp.abs(control[2])])
        return jnp.diag((jnp.asarray(self.floor) + jnp.asarray(self.share) * moved) ** 2)
