"""Model what an obstacle does to the step of a commanded body, which is neither stopped nor pushed by its commands.

An obstacle stops a body between its last pose and the predicted one, or lets it slide along a wall: the projections of
the commanded translation onto all walls fill the ball with that translation as its diameter.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SHOWN = 0.25  # of the commanded step: an image that leaves this std of it shows whether an obstacle was in the way


def unobstructed(moved: Float[Array, "p"], back: Float[Array, "p"], turns: Bool[np.ndarray, "p"]) -> Float[Array, "p"]:
    """Return what no obstacle explains of the step from the predicted pose to the estimate (eq. I28).

    Args:
        moved: from the predicted pose to the estimate, tangent of the predicted pose.
        back: from the predicted pose to the last one.
        turns: True for the coordinates that are angles.
    """
    turned = moved - jnp.clip(moved, jnp.minimum(back, 0.0), jnp.maximum(back, 0.0))
    off, radius = jnp.where(turns, 0.0, moved - back / 2), jnp.linalg.norm(jnp.where(turns, 0.0, back)) / 2
    beyond = jnp.maximum(0.0, 1.0 - radius / jnp.maximum(jnp.linalg.norm(off), 1e-9))
    return jnp.where(turns, turned, beyond * off)


def obstruction(back: Float[Array, "p"], turns: Bool[np.ndarray, "p"]) -> Float[Array, "p p"]:
    """Return the covariance of what an obstacle does to a step: it stops a body, or lets it slide, in any direction.

    Args:
        back: from the predicted pose to the last one.
        turns: True for the coordinates that are angles.
    """
    length = jnp.linalg.norm(jnp.where(turns, 0.0, back))
    return jnp.diag(jnp.where(turns, back**2, length**2))


def slid(back: Float[Array, "p"], turns: Bool[np.ndarray, "p"]) -> Float[Array, "starts p"]:
    """Return steps from the predicted pose that obstacles may leave: points of the ball's surface along each axis.

    Args:
        back: from the predicted pose to the last one.
        turns: True for the coordinates that are angles.
    """
    middle = jnp.where(turns, 0.0, back / 2)
    axes = jnp.eye(len(back))[np.flatnonzero(~turns)]
    return middle + jnp.linalg.norm(middle) * jnp.concatenate([axes, -axes])


def is_shown(covariance: Float[Array, "p p"], back: Float[Array, "p"], turns: Bool[np.ndarray, "p"]) -> Bool[Array, ""]:
    """``b^T Sigma b < (0.25 b^T b)^2``: an estimate fixes the commanded translation ``b``; False where there is none.

    Args:
        covariance: of the estimated pose.
        back: from the predicted pose to the last one.
        turns: True for the coordinates that are angles.
    """
    translation = jnp.where(turns, 0.0, back)
    return translation @ covariance @ translation < (SHOWN * translation @ translation) ** 2
