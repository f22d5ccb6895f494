"""Trace many rays through boxes of a belief by sphere tracing: the depths of the emission model in fewer steps.

Along a ray ``p(d) = c + d t`` (d in metres of z-depth) the emission takes samples at ``d_k = k e``, e = 0.4 voxels,
finds the first ``k > 1`` whose occupancy is above zero and puts the surface where the linear interpolation of samples
``k - 1`` and ``k`` crosses zero (:mod:`vssm_gym.model.emission`). Here the same ``k`` is found by sphere tracing. A
*piece* is the region between neighbouring nodes, of which ``fine`` lie to a cell; a multilinear field is largest at the
corners of a piece, so that a piece without a corner above zero is certified to be free.

    reach(piece) = distance from the piece to the nearest one that is not free; negative where it is not free itself

A ray leaps by the reach of its piece, at the least to where it leaves that piece, and tests each sample of cells that
are not free.

The field is that of a box cut from the map, in two dimensions or in three, and of several maps at once: samples of the
posterior.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import binary_dilation, distance_transform_edt

from vssm_gym.maps.compaction import first_set
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_MEAN
from vssm_gym.model.emission import STEP, TAU

HIT_OFFSET = float(1 << 20)  # added to the sample of a hit; no ray has as many samples, and float32 counts to 2^24
FIRST_SAMPLE = 2.0  # the first sample that can hit
LEAPS = 2  # between two tests of samples
GATHER_AT = (2, 8, 32)  # unfinished rays are gathered when one in 2, 8, 32 is left: grazing rays delay no others
GATHER_MULTIPLE = 64  # rays: gathering fewer does not pay; multiples of it fill vector registers
SLACK = 1e-3  # samples and cells: a point on the box's face counts as inside
Coordinates = tuple[Array, ...]  # one array a coordinate: operations over an axis of two or three do not vectorise


class RayField(eqx.Module):
    """Hold boxes of equal shape cut from one or several maps; see the module."""

    occupancy: Float[Array, "cells"]  # (maps, *shape) in C order, m
    reach: Float[Array, "pieces"]  # (maps, *pieces) in C order, samples of a ray of unit length
    origin: Float[Array, "dims"]  # world position of the centre of cell 0, m
    voxel_size: Float[Array, ""]  # m
    shape: tuple[int, ...] = eqx.field(static=True)  # cells along each axis
    fine: int = eqx.field(static=True)  # pieces a cell along each axis

    @classmethod
    def cut(
        cls, occupancy: Float[np.ndarray, "maps *shape"], origin: np.ndarray, voxel: float, fine: int
    ) -> "RayField":
        """Build the field from the occupancies at cell centres, m."""
        shape = occupancy.shape[1:]
        reach = np.stack([_reach(one, fine) for one in occupancy]).reshape(-1)
        device = partial(jnp.asarray, dtype=jnp.float32)
        return cls(device(occupancy.reshape(-1)), device(reach), device(origin), device(voxel), shape, fine)

    def strides(self) -> list[int]:
        """Return the memory strides of cells along each axis, and of maps at the end."""
        return _strides(self.shape)

    @property
    def pieces(self) -> tuple[int, ...]:
        """Return the number of pieces along each axis."""
        return tuple((n - 1) * self.fine for n in self.shape)


def _strides(sizes: tuple[int, ...]) -> list[int]:
    return [int(np.prod(sizes[axis + 1 :])) for axis in range(len(sizes))] + [int(np.prod(sizes))]


def at_nodes(occupancy: np.ndarray, axis: int, fine: int) -> np.ndarray:
    """Interpolate linearly to ``fine`` values a cell along ``axis``."""
    n = occupancy.shape[axis]
    below, above = np.take(occupancy, range(n - 1), axis), np.take(occupancy, range(1, n), axis)
    between = np.stack([below + (above - below) * (i / fine) for i in range(fine)], axis + 1)
    merged = between.reshape(*below.shape[:axis], -1, *below.shape[axis + 1 :])
    return np.concatenate([merged, np.take(above, [-1], axis)], axis)


def _reach(occupancy: np.ndarray, fine: int) -> np.ndarray:
    """Return the certified free samples around each piece; see the module."""
    for axis in range(occupancy.ndim):
        occupancy = at_nodes(occupancy, axis, fine)
    taken = occupancy > TAU
    for axis in range(taken.ndim):  # a piece is taken if any of its corners is
        n = taken.shape[axis]
        taken = np.take(taken, range(n - 1), axis) | np.take(taken, range(1, n), axis)
    if not taken.any():
        return np.full(taken.shape, 1e4, np.float32)
    # The distance between two pieces is that of one to the nearest piece on or next to the other.
    away = distance_transform_edt(~binary_dilation(taken, np.ones((3,) * taken.ndim, bool)))
    reach = np.maximum(away - 1e-3, 0.0) / (fine * STEP)  # 1e-3 pieces allow for rounding
    return np.where(taken, -1.0, reach).astype(np.float32)


class Rays(eqx.Module):
    """Hold rays in the units of a field: point ``start + k stride`` is sample ``k``."""

    which: Int[Array, "rays"]  # the map that a ray runs through
    start: Coordinates  # cells
    stride: Coordinates  # cells a sample
    inverse_length: Float[Array, "rays"]  # of a metre of z-depth, 1/m
    last: Float[Array, "rays"]  # last sample inside box and range


def rays_of(
    field: RayField, which: Int[Array, "rays"], centre: Coordinates, direction: Coordinates, max_depth: float | Array
) -> tuple[Rays, Float[Array, "rays"]]:
    """Convert rays to the field's units; return them and the first sample of each that may hit.

    Args:
        field: boxes.
        which: the map of each ray.
        centre: world coordinates of its start, m, each ``(rays,)``.
        direction: its vector for one metre of z-depth, at least 1 long, each coordinate ``(rays,)``.
        max_depth: z-depth at which it ends, m.
    """
    start = tuple((c - o) / field.voxel_size for c, o in zip(centre, field.origin, strict=True))
    stride = tuple(t * STEP for t in direction)
    inverse_length = jax.lax.rsqrt(sum(t * t for t in direction))
    range_ = jnp.floor(max_depth / (STEP * field.voxel_size))
    first, last = jnp.full(which.shape, FIRST_SAMPLE), jnp.broadcast_to(range_, which.shape)
    for s, t, n in zip(start, stride, field.shape, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
        near, far = -s * inverse, (n - 1.0 - s) * inverse
        first, last = jnp.maximum(first, jnp.minimum(near, far)), jnp.minimum(last, jnp.maximum(near, far))
    # A ray parallel to the box and outside it ends near -1e9, a number that float32 cannot count up from.
    k, last = jnp.ceil(first - SLACK), jnp.maximum(jnp.floor(last + SLACK), -1.0)
    return Rays(which, start, stride, inverse_length, last), jnp.minimum(k, last + 1.0)


def surface(field: RayField, rays: Rays, k: Float[Array, "rays"]) -> Float[Array, "rays"]:
    """Return where rays that are free before sample ``k`` meet the first surface, in samples; 0 without one."""
    found, index, some, rest = narrowed(field, rays, k, LEAPS)
    rest = jax.lax.while_loop(lambda k: jnp.any(k <= some.last), lambda k: _advance(field, some, k, LEAPS), rest)
    return crossing(field, rays, found.at[index].set(rest, mode="drop"))


def narrowed(
    field: RayField, rays: Rays, k: Float[Array, "rays"], count: int
) -> tuple[Array, Array, Rays, Float[Array, "some"]]:
    """Search until all rays but a few grazing ones have ended, with ``count`` leaps before the first test.

    Returns:
        ``k`` of each ray that has ended (+ HIT_OFFSET for a hit, above ``last`` without one); the numbers of the rays
        that have not, padded with the number of rays; these rays; and the samples before which they are free.
    """
    n = k.shape[0]
    index, found = jnp.arange(n), k
    for narrow in (subset_size(n, share) for share in GATHER_AT if n >= share * GATHER_MULTIPLE):

        def crowded(k, rays=rays, narrow=narrow):
            return jnp.sum(k <= rays.last) > narrow

        def advance(k, rays=rays, count=count):
            return _advance(field, rays, k, count)

        k = jax.lax.while_loop(crowded, advance, k)
        found = k if k.shape[0] == n else found.at[index].set(k, mode="drop")
        keep = first_set(k <= rays.last, narrow)
        index = index.at[keep].get(mode="fill", fill_value=n)
        rays, k = jax.tree.map(lambda a, keep=keep: a.at[keep].get(mode="clip"), (rays, k))
        rays = eqx.tree_at(lambda r: r.last, rays, jnp.where(index < n, rays.last, -1.0))
        count = LEAPS
    return found, index, rays, k


def crossing(field: RayField, rays: Rays, found: Float[Array, "rays"]) -> Float[Array, "rays"]:
    """Return where occupancy meets the threshold before the sample that hit, in samples; 0 without a hit."""
    hit = found >= HIT_OFFSET
    k = jnp.where(hit, found - HIT_OFFSET, FIRST_SAMPLE)
    o_k, o_before = (_value(field, rays.which, rays.start, rays.stride, at) for at in (k, k - 1.0))
    o_before = jnp.where(
        k > FIRST_SAMPLE, o_before, jnp.minimum(o_before, TAU)
    )  # the first sample never counts as a hit
    rise = o_k - o_before
    a = jnp.where(rise > 1e-9, (TAU - o_before) / jnp.where(rise > 1e-9, rise, 1.0), 1.0)
    return jnp.where(hit, k - 1.0 + a, 0.0)


def subset_size(n: int, share: int) -> int:
    """Return one in ``share`` of n rays, rounded up to GATHER_MULTIPLE."""
    return min(n, -(-n // (share * GATHER_MULTIPLE)) * GATHER_MULTIPLE)


def _advance(field: RayField, rays: Rays, k: Array, count: int) -> Array:
    if count:
        # A loop, because unrolled leaps are compiled into one kernel that computes each leap again for every use.
        k = jax.lax.fori_loop(0, count, lambda _, k: _leap(field, rays, k), k)
    return _test(field, rays, k)


def _leap(field: RayField, rays: Rays, k: Array) -> Array:
    """Advance past all samples that cannot hit; a ray whose next sample might stays."""
    *strides, per_map = _strides(field.pieces)
    number, exits = rays.which * per_map, jnp.full(k.shape, HIT_OFFSET)
    for s, t, n, stride in zip(rays.start, rays.stride, field.pieces, strides, strict=True):
        piece = jnp.clip(jnp.floor((s + t * k) * field.fine), 0.0, n - 1.0)
        number += piece.astype(jnp.int32) * stride
        inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
        exits = jnp.minimum(exits, ((piece + (inverse > 0)) / field.fine - s) * inverse)
    reach = field.reach.at[number].get(mode="promise_in_bounds")
    further = k + jnp.floor(reach * rays.inverse_length) + 1.0
    if field.fine * STEP < 1.0:  # else there is seldom a second sample in a piece
        further = jnp.maximum(further, jnp.floor(exits) + 1.0)
    return jnp.where((reach >= 0.0) & (k <= rays.last), further, k)


def _test(field: RayField, rays: Rays, k: Array) -> Array:
    """Test every sample of a ray in its present cell: the first one above the threshold is the hit."""
    cell, _, corners = _corners(field, rays.which, rays.start, rays.stride, k)
    exits = jnp.full(k.shape, HIT_OFFSET)
    for s, t, c in zip(rays.start, rays.stride, cell, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
        exits = jnp.minimum(exits, (c + (inverse > 0) - s) * inverse)
    beyond = jnp.minimum(jnp.maximum(jnp.floor(exits), k) + 1.0, rays.last + 1.0)
    samples = int(np.sqrt(len(field.shape)) / STEP) + 1
    following = beyond
    for i in reversed(range(samples)):
        at = k + i
        fractions = [s + t * at - c for s, t, c in zip(rays.start, rays.stride, cell, strict=True)]
        following = jnp.where((_multilinear(corners, fractions) > TAU) & (at < beyond), at + HIT_OFFSET, following)
    return jnp.where(k <= rays.last, following, k)


def _value(field: RayField, which: Array, start: Coordinates, stride: Coordinates, k: Array) -> Array:
    """Return the occupancy at sample ``k``; outside the box that of unobserved space."""
    cell, fractions, corners = _corners(field, which, start, stride, k)
    inside = jnp.ones(k.shape, bool)
    for c, f, n in zip(cell, fractions, field.shape, strict=True):
        inside &= (f >= -SLACK) & (c + f <= n - 1.0 + SLACK)
    return jnp.where(inside, _multilinear(corners, fractions), PRIOR_OCCUPANCY_MEAN)


def _corners(
    field: RayField, which: Array, start: Coordinates, stride: Coordinates, k: Array
) -> tuple[list[Array], list[Array], list[Array]]:
    """Return the cell of sample ``k``, the fractions in it, and its corners' occupancies, last axis fastest."""
    at = [s + t * k for s, t in zip(start, stride, strict=True)]
    cell = [jnp.clip(jnp.floor(p), 0.0, n - 2.0) for p, n in zip(at, field.shape, strict=True)]
    *strides, per_map = field.strides()
    low = which * per_map
    for c, stride_ in zip(cell, strides, strict=True):
        low += c.astype(jnp.int32) * stride_
    offsets = [0]
    for stride_ in strides:
        offsets = [o + more for o in offsets for more in (0, stride_)]
    corners = [field.occupancy.at[low + offset].get(mode="promise_in_bounds") for offset in offsets]
    return cell, [p - c for p, c in zip(at, cell, strict=True)], corners


def _multilinear(corners: list[Array], fractions: list[Array]) -> Array:
    """Interpolate between ``2^dims`` corners, last axis fastest, at fractions in [0, 1]."""
    for f in reversed(fractions):
        corners = [a + f * (b - a) for a, b in zip(corners[0::2], corners[1::2], strict=True)]
    return corners[0]
