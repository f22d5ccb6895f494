"""Adaptive process noise: how much a hand changes its velocity is learned from how wrong the prediction was.

    s^2 <- s^2 + (1 - exp(-dt / tau)) (c^2 mean(e^2) / E[e^2 | s = 1] - f s^2),   floor^2 <= s^2 <= 1

``e`` is what alignment moved the pose from the prediction by, and ``s`` scales the standard deviations of
:class:`~vssm_gym.transition.rigid.RigidNoise`, one for translation and one for rotation (ours; innovation-based
adaptive estimation after Mehra, "Approaches to adaptive filtering", 1972). ``f = 1 - tr(Sigma P^-1) / 3`` is the share
of the prediction's uncertainty that the image removed: along what it does not see, an ``e`` of zero says nothing of the
hand. A steady hand keeps a tight prior, which holds the pose where the image does not (in front of a bare wall), and a
velocity with a band that means something; an unsteady one gets the configured noise, the most that is ever assumed.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.transition.rigid import RigidNoise

TIME = 1.0  # s, over which the level follows
FLOOR = 0.2  # of the configured std, below which no hand is trusted
CAUTION = 1.5  # the next innovation may be larger than the last ones

Level = Float[Array, "2"]  # s^2 of translation and of rotation


def full() -> Level:
    """The configured noise: nothing is known of the hand yet."""
    return jnp.ones(2)


def scaled(noise: RigidNoise, level: Level) -> RigidNoise:
    """``noise`` with its standard deviations at ``level``."""
    linear, angular = jnp.sqrt(level)
    return RigidNoise(
        noise.vel_translation * linear,
        noise.pose_translation * linear,
        noise.vel_rotation * angular,
        noise.pose_rotation * angular,
    )


def adapt(
    level: Level,
    moved: Float[Array, "6"],
    predicted: Float[Array, "6 6"],
    posterior: Float[Array, "6 6"],
    dt: Float[Array, ""],
    noise: RigidNoise,
) -> Level:
    """The level after an image.

    Args:
        level: Before it.
        moved: ``e = log(predicted^-1 pose)``, translation (m) and rotation (rad) in the body's frame.
        predicted: P, covariance of the pose before the image.
        posterior: Sigma, after it.
        dt: Length of the step, s.
        noise: At level 1; what it adds to a pose within a step is what ``e`` is compared with.
    """
    pose, velocity = noise.variances(dt)
    expected = (pose + velocity * dt**2).reshape(2, 3).mean(axis=1)
    blocks = [slice(0, 3), slice(3, 6)]
    left = jnp.stack([jnp.trace(jnp.linalg.solve(predicted[b, b], posterior[b, b])) / 3.0 for b in blocks])
    told = jnp.clip(1.0 - left, 0.0, 1.0)
    seen = CAUTION**2 * jnp.mean(moved.reshape(2, 3) ** 2, axis=1) / expected
    rate = 1.0 - jnp.exp(-dt / TIME)
    return jnp.clip(level + rate * (jnp.minimum(seen, told) - told * level), FLOOR**2, 1.0)
