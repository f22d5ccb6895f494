"""Where whole blocks of an image's pixels are free: found for the block before its rays are searched one by one.

A pixel's ray ``c + d t_p`` parts from the one through the block's middle by ``|t_p - t| d`` at the most. As far as the
reach of a piece exceeds that (:func:`vssm_gym.envs.world_model.rays.leaps`), all the block's rays are free. Blocks of
8 x 8 pixels begin, their quarters go on from where they stopped, and those of 2 x 2 after them.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.envs.world_model.rays import FIRST, RayField, Rays, leaps

LEVELS = ((8, 8), (4, 6), (2, 4))  # pixels along a block's side, leaps
Casting = Callable[[Array, Array], tuple[Rays, Array]]


def block_starts(
    field: RayField, cast: Casting, across: Float[Array, "width"], down: Float[Array, "height"], images: int
) -> Float[Array, "rays"]:
    """Samples before which the pixels of blocks are free, a number a pixel: images, rows and columns in C order.

    Args:
        field: what rays run through.
        cast: gives the rays of all images through these columns and rows, and the first sample of each that may hit.
        across: the columns: camera x a metre of z-depth.
        down: the rows.
        images: how many.
    """
    k = jnp.full((images, 1, 1), FIRST)
    for side, count in LEVELS:
        (x, off_x), (y, off_y) = _middles(across, side), _middles(down, side)
        rays, first = cast(x, y)
        # Where the middle begins outside the box, other pixels may be inside it before.
        rays = eqx.tree_at(lambda r: r.last, rays, jnp.where(first <= FIRST, rays.last, -1.0))
        size = (images, len(y), len(x))
        spread = jnp.broadcast_to(jnp.hypot(off_y[:, None], off_x), size).reshape(-1)
        k = _finer(k, size).reshape(-1)
        k = leaps(field, rays, k, count, spread).reshape(size)
    return _finer(k, (images, len(down), len(across))).reshape(-1)


def _middles(places: Float[Array, "n"], side: int) -> tuple[Float[Array, "blocks"], Float[Array, "blocks"]]:
    """Of each block of ``side`` places in a row, its middle and how far its outermost place is from there."""
    blocks = jnp.pad(places, (0, -len(places) % side), mode="edge").reshape(-1, side)
    return 0.5 * (blocks[:, 0] + blocks[:, -1]), 0.5 * jnp.abs(blocks[:, -1] - blocks[:, 0])


def _finer(k: Float[Array, "images h w"], size: tuple[int, int, int]) -> Float[Array, "images rows columns"]:
    """The numbers of blocks for the smaller ones in them."""
    for axis in (1, 2):
        k = jnp.repeat(k, -(-size[axis] // k.shape[axis]), axis=axis)
    return k[:, : size[1], : size[2]]
