"""Adaptive process noise: how much a hand changes its velocity is learned from how wrong the prediction was.

    s^2 <- s^2 + (1 - exp(-dt / tau)) (c^2 mean(e^2) / E[e^2 | s = 1] - s^2),   floor^2 <= s^2 <= 1

``e`` is the innovation of the pose, what alignment moved it from the prediction by, and ``s`` scales the standard
deviations of :class:`~vssm_gym.transition.rigid.RigidNoise`, one for translation and one for rotation (ours;
innovation-based adaptive estimation after Mehra, "Approaches to adaptive filtering", 1972). A steady hand keeps a tight
prior, which holds the pose where the image does not (in front of a bare wall), and a velocity with a band that means
something; an unsteady one gets the configured noise, which is the most that is ever assumed.
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


def adapt(level: Level, innovation: Float[Array, "6"], dt: Float[Array, ""], noise: RigidNoise) -> Level:
    """The level after an innovation.

    Args:
        level: Before it.
        innovation: ``log(predicted^-1 pose)``, translation (m) and rotation (rad) in the body's frame.
        dt: Length of the step, s.
        noise: At level 1; what it adds to a pose within a step is what an innovation is compared with.
    """
    pose, velocity = noise.variances(dt)
    expected = (pose + velocity * dt**2).reshape(2, 3).mean(axis=1)
    seen = CAUTION**2 * jnp.mean(innovation.reshape(2, 3) ** 2, axis=1) / expected
    gain = 1.0 - jnp.exp(-dt / TIME)
    return jnp.clip(level + gain * (jnp.minimum(seen, 1.0) - level), FLOOR**2, 1.0)
