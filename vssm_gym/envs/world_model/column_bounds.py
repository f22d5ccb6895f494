"""Bound how far the rays of a pixel column are free, before rays are searched one by one.

The rays of one pixel column of an upright camera, ``c + d (t_x, t_y, r)``, differ in their rise r alone: all lie above
the same horizontal line of the floor plan. Over each piece of the plan the space around a height is free from ``low``
to ``high`` (relative to that height). One walk along the line thus bounds all rays of the column: to where the line
leaves piece j, the rays are free whose rise is

    max_{i <= j} low_i / d_i <= r <= min_{i <= j} high_i / d_i

with ``d_i`` the z-depth where the line enters or leaves piece i, whichever is stricter.

Occupancy is linear in height between two layers of cells and largest at a piece's corners: low and high are the heights
where the first of its four edges meets the threshold. Each piece stores the bounds of the largest square of pieces
around it over which they are nearly the same, and the walk leaps from square to square. The space around the camera's
height and the space halfway to the ceiling, above furniture, hold nearly all rays; the others are left to the search of
single rays (:mod:`vssm_gym.envs.world_model.rays`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import minimum_filter

from vssm_gym.envs.world_model.rays import FIRST_SAMPLE, HIT_OFFSET, SLACK, RayField, Rays, at_nodes
from vssm_gym.model.emission import STEP, TAU

FINE = 4  # pieces of the plan a cell along each axis
SQUARES = (1, 2, 4, 8, 16, 32)  # pieces from the middle of a square to its border
# Bounds count as nearly the same if they differ by no more than NEARLY (cells) + NEARLY_OF_HEIGHT of the bound.
NEARLY, NEARLY_OF_HEIGHT = 0.1, 0.01
LINE_SQUARES = 32  # squares that a line is followed through; rays that go on are searched one by one


class ColumnBounds(eqx.Module):
    """Hold the free heights over the floor plan of a :class:`RayField`; see the module.

    Arrays are flat: (2, maps, *pieces) in C order, for the spaces around two heights.
    """

    low: Float[Array, "pieces"]  # cells from the camera's height; above high where the space is not free
    high: Float[Array, "pieces"]
    reach: Float[Array, "pieces"]  # cells from the piece to the border of its square

    @classmethod
    def of(cls, field: RayField, camera: float) -> "ColumnBounds":
        """Compute the bounds around a camera at ``camera`` m, and halfway from there to the ceiling."""
        maps = np.asarray(field.occupancy).reshape(-1, *field.shape)
        level = (camera - float(field.origin[2])) / float(field.voxel_size)
        near = _space(maps, level)
        free = near[0] <= near[1]
        above = 0.5 * float(np.median(near[1][free])) if free.any() else 0.0
        low, high, reach = _space(maps, level + above)
        far = np.stack([low + above, high + above, reach])
        return cls(*(jnp.asarray(np.stack(both).reshape(-1), jnp.float32) for both in zip(near, far, strict=True)))

    def first_samples(
        self, field: RayField, lines: Rays, first: Float[Array, "columns"], down: Float[Array, "rows"]
    ) -> Float[Array, "rows columns"]:
        """Return for each row and pixel column the sample before which its ray is free.

        Args:
            field: the field of these bounds.
            lines: horizontal rays at the camera's height, one a pixel column.
            first: the first sample of each line that may hit.
            down: slopes of the rows: metres downward a metre of z-depth.
        """
        nx, ny = ((n - 1) * FINE for n in field.shape[:2])
        n = 2 * len(first)  # each line in both spaces
        last = jnp.where(first <= FIRST_SAMPLE, lines.last, -1.0)  # a line that begins outside the plan is not followed
        last, start, stride = jax.tree.map(lambda a: jnp.concatenate([a, a]), (last, lines.start[:2], lines.stride[:2]))
        which = jnp.concatenate([lines.which, lines.which + len(self.low) // (2 * nx * ny)])

        def follow(carry: Any) -> Any:
            j, k, bounds, all_k, all_bounds = carry
            number, at = which * (nx * ny), []
            for s, t, count, step in zip(start, stride, (nx, ny), (ny, 1), strict=True):
                at.append(jnp.clip(jnp.floor((s + t * k) * FINE), 0.0, count - 1.0))
                number += at[-1].astype(jnp.int32) * step
            low, high, reach = (a.at[number].get(mode="promise_in_bounds") for a in (self.low, self.high, self.reach))
            exits = jnp.full(n, HIT_OFFSET)
            for s, t, piece in zip(start, stride, at, strict=True):
                inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
                border = jnp.where(inverse > 0, (piece + 1.0) / FINE + reach, piece / FINE - reach)
                exits = jnp.minimum(exits, (border - s) * inverse)
            end = jnp.maximum(jnp.floor(exits), k)
            within = jnp.stack([-low, high]) - SLACK
            over = (low > high) | (k > last)
            bounds = jnp.minimum(bounds, jnp.where(over, -1.0, within / jnp.where(within > 0.0, end, k)))
            k = jnp.where(over, HIT_OFFSET, end + 1.0)
            all_k = jax.lax.dynamic_update_slice(all_k, k[None], (j + 1, 0))
            return j + 1, k, bounds, all_k, jax.lax.dynamic_update_slice(all_bounds, bounds[None], (j, 0, 0))

        k = jnp.full(n, FIRST_SAMPLE)
        *_, all_k, all_bounds = jax.lax.while_loop(
            lambda carry: (carry[0] < LINE_SQUARES) & jnp.any(carry[1] <= last),
            follow,
            (
                0,
                k,
                jnp.full((2, n), HIT_OFFSET),
                jnp.full((LINE_SQUARES + 1, n), FIRST_SAMPLE),
                jnp.full((LINE_SQUARES + 1, 2, n), -1.0),
            ),
        )
        free = _free(all_k, all_bounds, -STEP * down[:, None])
        return jnp.maximum(free[:, : n // 2], free[:, n // 2 :])


def _free(
    all_k: Float[Array, "squares n"], all_bounds: Float[Array, "squares 2 n"], rise: Float[Array, "rows 1"]
) -> Float[Array, "rows n"]:
    """Return the sample before which each row's ray is free, from the bounds of the squares that its line passed."""
    n = all_k.shape[1]
    # Comparing with all squares is cheaper than bisection, which gathers. In a loop, because what is unrolled is
    # computed anew for each of its uses.
    passes = lambda j: (rise >= -all_bounds[j, 0]) & (rise <= all_bounds[j, 1])
    passed = jnp.zeros((len(rise), n), jnp.int32)
    passed = jax.lax.fori_loop(0, LINE_SQUARES, lambda j, passed: passed + passes(j).astype(jnp.int32), passed)
    # The ray may cross a part of the next square: where it leaves there, that square alone bounds it.
    steep, upward, line = jnp.abs(rise), (rise > 0.0).astype(jnp.int32), jnp.arange(n)
    bound = lambda side: all_bounds.reshape(-1).at[(2 * passed + side) * n + line].get(mode="promise_in_bounds")
    k_of = lambda j: all_k.reshape(-1).at[j * n + line].get(mode="promise_in_bounds")
    k, after = k_of(passed), k_of(jnp.minimum(passed + 1, LINE_SQUARES))
    leaves = jnp.floor(bound(upward) * (after - 1.0) / jnp.maximum(steep, 1e-9)) + 1.0
    return jnp.where(bound(1 - upward) >= -steep, jnp.clip(leaves, k, jnp.maximum(k, after)), k)


def _space(maps: Float[np.ndarray, "maps nx ny nz"], level: float) -> Float[np.ndarray, "3 maps pieces_x pieces_y"]:
    """Return low and high relative to ``level`` (cells), and reach, of every map."""
    top = maps.shape[3] - 1
    return np.stack([_squares(_free_height(m[:, :, ::-1], top - level), _free_height(m, level)) for m in maps], axis=1)


def _free_height(occupancy: Float[np.ndarray, "nx ny nz"], level: float) -> Float[np.ndarray, "pieces_x pieces_y"]:
    """Return how many cells upward from ``level`` are free over each piece of the plan, up to the field's end."""
    nz = occupancy.shape[2]
    if not 0.0 <= level <= nz - 1:
        return np.zeros([(n - 1) * FINE for n in occupancy.shape[:2]])
    nodes = at_nodes(at_nodes(occupancy, 0, FINE), 1, FINE)
    layer = min(int(level), nz - 2)
    before = nodes[:, :, layer] + (level - layer) * (nodes[:, :, layer + 1] - nodes[:, :, layer])
    free, at = np.where(before > TAU, 0.0, np.inf), level
    for z in range(layer + 1, nz):
        now = nodes[:, :, z]
        with np.errstate(divide="ignore", invalid="ignore"):
            meets = at - level + (TAU - before) / (now - before) * (z - at)
        free = np.where((now > TAU) & np.isinf(free), meets, free)
        before, at = now, float(z)
    free = np.minimum(free, nz - 1 - level)
    free = np.minimum(free[1:], free[:-1])
    return np.minimum(free[:, 1:], free[:, :-1])


def _squares(below: np.ndarray, above: np.ndarray) -> Float[np.ndarray, "3 pieces_x pieces_y"]:
    """Return low, high and reach of the largest square around each piece with nearly the same free heights."""
    free = (below > 0.0) & (above > 0.0)
    least = [np.where(free, one, 0.0) for one in (below, above)]
    required = [one - NEARLY - NEARLY_OF_HEIGHT * one for one in least]
    reach, going = np.zeros(below.shape), free
    for border in SQUARES:
        around = [minimum_filter(np.where(free, one, 0.0), 2 * border + 1, mode="nearest") for one in (below, above)]
        going = going & np.all([(a >= w) & (a > 0.0) for a, w in zip(around, required, strict=True)], axis=0)
        least = [np.where(going, a, one) for a, one in zip(around, least, strict=True)]
        reach[going] = border / FINE
    return np.stack([np.where(free, -least[0], 1.0), np.where(free, least[1], -1.0), reach])
