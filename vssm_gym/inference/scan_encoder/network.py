"""Encode a scan: ``q(z | x)``, a mixture of Gaussians over x, y and heading, by a network (eq. P48).

Places that look alike are modes of one belief, which a single Gaussian would put between them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces

NEAR_RANGE = 0.15  # of the scanner's range, that the second copy of a scan resolves
OUTPUTS = 8  # of a component: weight, x, y, cosine, sine, three standard deviations
LEAST_PLACE_STD, LEAST_HEADING_STD = 0.003, 0.01  # m, rad


class PoseMixture(eqx.Module):
    """Hold a mixture over poses; errors of the heading are taken on the circle.

    Attributes:
        log_weight: of the components.
        mean: x, y (m), heading (rad).
        std: of each.
    """

    log_weight: Float[Array, "k"]
    mean: Float[Array, "k 3"]
    std: Float[Array, "k 3"]

    def log_prob(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the log density, nats."""
        away = state[..., None, :] - self.mean
        away = jnp.concatenate([away[..., :2], wrap_angle(away[..., 2:])], axis=-1) / self.std
        normal = jnp.sum(jnp.log(self.std), axis=-1) + 1.5 * jnp.log(2.0 * jnp.pi)
        each = -0.5 * jnp.sum(away**2, axis=-1) - normal
        return jax.scipy.special.logsumexp(self.log_weight + each, axis=-1)

    def sample(self, key: PRNGKeyArray, draws: int) -> Float[Array, "draws 3"]:
        """Draw poses."""
        by_choice, by_error = jax.random.split(key)
        k = jax.random.categorical(by_choice, self.log_weight, shape=(draws,))
        drawn = self.mean[k] + self.std[k] * jax.random.normal(by_error, (draws, 3))
        return drawn.at[:, 2].set(wrap_angle(drawn[:, 2]))


class ScanEncoder(eqx.Module):
    """Hold the network and the prior under which it was trained.

    Attributes:
        layers: weights and offsets.
        prior: over poses.
        max_range: of the scanner, m.
    """

    layers: list[tuple[Float[Array, "_ _"], Float[Array, "_"]]]
    prior: VisitedPlaces
    max_range: Float[Array, ""]

    def __call__(self, ranges: Float[Array, "beams"]) -> PoseMixture:
        """Return the belief after one scan; a reading of 0 counts as the scanner's range."""
        r = jnp.where(ranges > 0.0, ranges, self.max_range) / self.max_range
        h = jnp.concatenate([r, jnp.minimum(r, NEAR_RANGE) / NEAR_RANGE])
        for w, b in self.layers[:-1]:
            h = jax.nn.silu(h @ w + b)
        out = (h @ self.layers[-1][0] + self.layers[-1][1]).reshape(-1, OUTPUTS)
        low, high = jnp.min(self.prior.places, axis=0), jnp.max(self.prior.places, axis=0)
        xy = 0.5 * (low + high) + 0.5 * (high - low) * out[:, 1:3]
        heading = jnp.arctan2(out[:, 4], out[:, 3] + 1e-6)
        least = jnp.array([LEAST_PLACE_STD, LEAST_PLACE_STD, LEAST_HEADING_STD])
        std = least + jnp.exp(jnp.clip(out[:, 5:] - 2.0, -8.0, 2.0))
        return PoseMixture(jax.nn.log_softmax(out[:, 0]), jnp.concatenate([xy, heading[:, None]], axis=-1), std)


def new_encoder(
    key: PRNGKeyArray, beams: int, max_range: float, prior: VisitedPlaces, width: int, components: int
) -> ScanEncoder:
    """Draw an encoder with three hidden layers."""
    sizes = [2 * beams, width, width, width, OUTPUTS * components]
    layers = []
    for k, a, b in zip(jax.random.split(key, len(sizes) - 1), sizes[:-1], sizes[1:], strict=True):
        layers.append((jax.random.normal(k, (a, b)) * jnp.sqrt(2.0 / a), jnp.zeros(b)))
    spread = jax.random.normal(key, (OUTPUTS * components,)).reshape(-1, OUTPUTS) * jnp.array([0, 1, 1, 1, 1, 0, 0, 0])
    layers[-1] = (0.1 * layers[-1][0], 0.5 * spread.reshape(-1))
    return ScanEncoder(layers, prior, jnp.float32(max_range))
