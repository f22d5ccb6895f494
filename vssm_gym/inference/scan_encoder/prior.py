"""Describe where a robot may be that has driven through a map: ``p(z)``, the places of the drive, any heading.

p(x, y) = mean_i N((x, y); place_i, std^2),    p(heading) = 1 / 2 pi
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError

MOST_KERNELS = 1024  # places that are kept of a drive


class VisitedPlaces(eqx.Module):
    """Hold a kernel density of the places that a drive has visited, as the filter of the drive has estimated them.

    How often it was at a place does not count: kernels are evenly spread over the plane, at most one in a square whose
    side is their standard deviation.

    Attributes:
        places: x, y, m.
        std: of each kernel, m.
    """

    places: Float[Array, "n 2"]
    std: Float[Array, ""]

    @classmethod
    def of(cls, poses: Float[np.ndarray, "n k"], std: float) -> "VisitedPlaces":
        """Return the density of a drive.

        Args:
            poses: x, y (m) and whatever follows, in the order of time.
            std: of each kernel, m.

        Raises:
            InputError: no pose, or a kernel without width.
        """
        if not len(poses) or not std > 0.0:
            raise InputError("VisitedPlaces", "poses", f"one or more, and a std above 0 m; found {len(poses)}, {std!r}")
        xy = np.asarray(poses)[:, :2]
        first = np.unique(np.floor(xy / std).astype(np.int64), axis=0, return_index=True)[1]
        chosen = np.sort(first)[
            np.unique(np.linspace(0, len(first) - 1, min(len(first), MOST_KERNELS)).round().astype(int))
        ]
        return cls(jnp.asarray(xy[chosen], jnp.float32), jnp.float32(std))

    def sample(self, key: PRNGKeyArray, draws: int) -> Float[Array, "draws 3"]:
        """Draw poses."""
        by_place, by_error, by_heading = jax.random.split(key, 3)
        place = self.places[jax.random.randint(by_place, (draws,), 0, len(self.places))]
        xy = place + self.std * jax.random.normal(by_error, (draws, 2))
        heading = jax.random.uniform(by_heading, (draws, 1), minval=-jnp.pi, maxval=jnp.pi)
        return jnp.concatenate([xy, heading], axis=-1)

    def log_prob(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density, nats."""
        away = (state[..., None, :2] - self.places) / self.std
        each = -0.5 * jnp.sum(away**2, axis=-1)
        normal = jnp.log(2.0 * jnp.pi * self.std**2) + jnp.log(float(len(self.places))) + jnp.log(2.0 * jnp.pi)
        return jax.scipy.special.logsumexp(each, axis=-1) - normal
