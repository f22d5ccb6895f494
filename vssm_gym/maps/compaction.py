"""Compact flags into lists of static shape, so that a loop with a dynamic trip count visits only the set ones.

``jnp.nonzero`` of a large mask takes milliseconds on a CPU, most of them for flags that are not set.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

ROW = 128  # flags whose running count is one product of matrices
FLAG_GROUP = 64  # flags that are tested together
FLAGS_A_TURN = 1024  # flags per loop iteration


def first_set(mask: Bool[Array, "n"], size: int) -> Int[Array, "size"]:
    """``jnp.nonzero(mask, size=size, fill_value=n)`` at a third of its cost; set flags beyond ``size`` are left out."""
    n = mask.shape[0]
    table = jnp.pad(mask, (0, -n % ROW)).reshape(-1, ROW).astype(jnp.float32)
    within = table @ jnp.triu(jnp.ones((ROW, ROW), jnp.float32))  # running counts along rows, exact in float32
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    place = (before[:, None] + within - 1.0).astype(jnp.int32).reshape(-1)[:n]
    at = jnp.where(mask, place, size)
    return jnp.full(size, n, jnp.int32).at[at].set(jnp.arange(n, dtype=jnp.int32), mode="drop")


def empty_list(n: int) -> tuple[Array, Array]:
    """Return a list with room for the numbers ``0..n-1``, each once, filled with ``n``; and its length, 0."""
    return jnp.full(n + FLAGS_A_TURN, n, jnp.int32), jnp.asarray(0, jnp.int32)


def append(listed: tuple[Array, Array], numbers: Int[Array, "turn"], mask: Bool[Array, "turn"]) -> tuple[Array, Array]:
    """Append those of ``FLAGS_A_TURN`` numbers whose flag is set to the list."""
    buffer, length = listed
    fill = buffer.shape[0] - FLAGS_A_TURN
    chosen = numbers.at[first_set(mask, FLAGS_A_TURN)].get(mode="fill", fill_value=fill)
    return jax.lax.dynamic_update_slice(buffer, chosen, (length,)), length + jnp.sum(mask, dtype=jnp.int32)


def set_numbers(mask: Bool[Array, "n"]) -> tuple[Array, Array]:
    """Return the numbers of the set flags in ascending order, then fill ``n``; and their count."""
    n = mask.shape[0]
    table = jnp.pad(mask, (0, -n % FLAG_GROUP)).reshape(-1, FLAG_GROUP)
    busy = jnp.any(table, axis=1)
    groups = table.shape[0]
    at_once = FLAGS_A_TURN // FLAG_GROUP
    order = jnp.pad(first_set(busy, groups), (0, at_once), constant_values=groups)

    def turn(i, listed):
        group = jax.lax.dynamic_slice(order, (i * at_once,), (at_once,))
        flags = table.at[group].get(mode="fill", fill_value=False)
        numbers = group[:, None] * FLAG_GROUP + jnp.arange(FLAG_GROUP)
        return append(listed, numbers.reshape(-1), flags.reshape(-1))

    return jax.lax.fori_loop(0, -(-jnp.sum(busy, dtype=jnp.int32) // at_once), turn, empty_list(n))
