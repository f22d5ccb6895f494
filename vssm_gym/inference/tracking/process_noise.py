"""Adapt the process noise: learn from the prediction errors how much a hand changes its velocity.

    s^2 <- s^2 + (1 - exp(-dt / tau)) (min(f, c^2 mean(e^2) / E[e^2 | s = 1]) - f s^2),   floor^2 <= s^2 <= 1

``e`` is the correction of the predicted pose by the alignment, and ``s`` scales the standard deviations of a
transition's noise, one scale for translation and one for rotation (ours; innovation-based adaptive estimation after
Mehra, "Approaches to adaptive filtering", 1972). ``f = 1 - tr(Sigma P^-1) / 3`` is the share of the prediction's
uncertainty that the image removed: in directions that the image does not observe, a zero ``e`` is no evidence of a
steady hand. A steady hand keeps a tight prior, which holds the pose where the image does not (in front of a bare wall),
and a calibrated velocity; an unsteady one gets the configured noise, the largest that is ever assumed.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.model.transition.manifold import Manifold

NoiseScale = Float[Array, "2"]  # s^2, factors of the noise variances of translation and of rotation


@dataclass(frozen=True)
class ProcessNoiseConfig:
    """Configure the adaptation of the process noise."""

    time_constant: float = 1.0  # s, tau
    floor: float = 0.2  # smallest scale of the configured std
    caution: float = 1.5  # c, because the next innovation may be larger than the last ones


def full() -> NoiseScale:
    """Return the scale of the configured noise, before anything is known of the hand."""
    return jnp.ones(2)


def scale(manifold: Manifold, noise_scale: NoiseScale) -> Float[Array, "n"]:
    """Return the factor of the noise's standard deviation for each coordinate of a state's error (eq. I18)."""
    linear, angular = jnp.sqrt(noise_scale)
    return jnp.where(manifold.turns, angular, linear)


def adapt(
    noise_scale: NoiseScale,
    moved: Float[Array, "p"],
    predicted: Float[Array, "p p"],
    posterior: Float[Array, "p p"],
    dt: Float[Array, ""],
    noise: Float[Array, "p p"],
    manifold: Manifold,
    config: ProcessNoiseConfig,
) -> NoiseScale:
    """Update the process-noise scale with an image (eq. I18).

    Args:
        noise_scale: Before it.
        moved: ``e = log(predicted^-1 pose)``, translation (m) and rotation (rad) in the body's frame.
        predicted: P, covariance of the pose before the image.
        posterior: Sigma, after it.
        dt: Length of the step, s.
        noise: Covariance that a step adds to a pose at scale 1, which normalises ``e``.
        manifold: Which coordinates are rotations.
        config: Time constant and limits.
    """
    turns = manifold.turns[: moved.shape[0]]
    blocks = [np.flatnonzero(~turns), np.flatnonzero(turns)]
    expected = jnp.stack([jnp.mean(jnp.diagonal(noise)[b]) for b in blocks])
    part = lambda a, b: a[np.ix_(b, b)]
    left = jnp.stack([jnp.trace(jnp.linalg.solve(part(predicted, b), part(posterior, b))) / len(b) for b in blocks])
    removed = jnp.clip(1.0 - left, 0.0, 1.0)  # f
    seen = config.caution**2 * jnp.stack([jnp.mean(moved[b] ** 2) for b in blocks]) / expected
    rate = 1.0 - jnp.exp(-dt / config.time_constant)
    return jnp.clip(noise_scale + rate * (jnp.minimum(seen, removed) - removed * noise_scale), config.floor**2, 1.0)
