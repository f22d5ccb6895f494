"""``exp(s, 0, turn)``: the arc of a body that moves along its heading at a constant curvature."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def arc_of(length: Float[Array, "*batch"], turn: Float[Array, "*batch"]) -> Float[Array, "*batch 3"]:
    """Return displacement (forward, left, m) and turn (rad), in the body frame at the start of an arc (eq. M24).

    Args:
        length: driven along the arc, m, negative backwards.
        turn: counter-clockwise, rad.
    """
    # sin(a)/a and (1 - cos a)/a = a/2 (sin(a/2) / (a/2))^2: neither cancels, and their derivatives do not at zero
    return jnp.stack([length * _sinc(turn), length * 0.5 * turn * _sinc(0.5 * turn) ** 2, turn], axis=-1)


def _sinc(a: Array) -> Array:
    """``sin(a) / a``, by its series near zero."""
    near = jnp.abs(a) < 0.1
    safe = jnp.where(near, 1.0, a)
    return jnp.where(near, 1.0 - a**2 / 6.0 * (1.0 - a**2 / 20.0), jnp.sin(safe) / safe)
