"""Many rays at once through pieces of a belief: the emission's own depths, found in fewer steps.

Along a ray ``p(d) = c + d t`` (d in metres of z-depth) the emission takes samples at ``d_k = k e``, e = 0.4 voxels,
finds the first ``k > 1`` whose occupancy is above zero and puts the surface where the linear interpolation of samples
``k - 1`` and ``k`` crosses zero (:mod:`vssm_gym.emission`). Here the same ``k`` is found by sphere tracing:

    reach(q) = distance from the node q to the nearest piece between nodes that has a corner above zero, less half a
               piece's diagonal

so that no sample within ``reach`` of any point nearest to q can hit. Nodes lie ``fine`` to a cell: a multilinear field
is largest at the corners of a piece, so pieces without a node above zero are certified.

The field is that of a box cut from the map, in two dimensions or in three, and of several maps at once: samples of the
posterior.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import distance_transform_edt

from vssm_gym.compaction import first_set
from vssm_gym.emission import STEP, TAU

HIT = float(1 << 20)  # added to the sample of a hit; no ray has as many samples, and float32 counts to 2^24
FIRST = 2.0  # the first sample that can hit
FLIGHT = 1  # leaps before the first look: rays start in the open
NARROWING = (2, 8, 32)  # rays are gathered when so small a share of them is left: a few that graze hold up no others
LEAST = 64  # rays: fewer are not worth gathering, and gathered are multiples of it, which fill vector registers
Coordinates = tuple[Array, ...]  # one array a coordinate: what runs over an axis of two or three does not vectorise


class RayField(eqx.Module):
    """Boxes of equal shape cut from one or several maps; see the module."""

    occupancy: Float[Array, "cells"]  # (maps, *shape) in C order, m
    reach: Float[Array, "nodes"]  # (maps, *nodes) in C order, samples of a ray of unit length
    origin: Float[Array, "dims"]  # world position of the centre of cell 0, m
    voxel_size: Float[Array, ""]  # m
    shape: tuple[int, ...] = eqx.field(static=True)  # cells along each axis
    fine: int = eqx.field(static=True)  # nodes a cell

    @classmethod
    def cut(
        cls, occupancy: Float[np.ndarray, "maps *shape"], origin: np.ndarray, voxel: float, fine: int
    ) -> "RayField":
        """From the occupancies at cell centres, m."""
        shape = occupancy.shape[1:]
        reach = np.stack([_reach(one, fine) for one in occupancy]).reshape(-1)
        device = partial(jnp.asarray, dtype=jnp.float32)
        return cls(device(occupancy.reshape(-1)), device(reach), device(origin), device(voxel), shape, fine)

    def strides(self, per_cell: int = 1) -> list[int]:
        """How far apart in memory neighbours along each axis lie, of cells or of nodes; the last is that of maps."""
        sizes = [(n - 1) * per_cell + 1 for n in self.shape]
        return [int(np.prod(sizes[axis + 1 :])) for axis in range(len(sizes))] + [int(np.prod(sizes))]


def _reach(occupancy: np.ndarray, fine: int) -> np.ndarray:
    """Certified free samples around each node; see the module."""
    for axis in range(occupancy.ndim):  # at the nodes: the interpolant is linear along each axis
        n = occupancy.shape[axis]
        below, above = np.take(occupancy, range(n - 1), axis), np.take(occupancy, range(1, n), axis)
        between = np.stack([below + (above - below) * (i / fine) for i in range(fine)], axis + 1)
        merged = between.reshape(*below.shape[:axis], -1, *below.shape[axis + 1 :])
        occupancy = np.concatenate([merged, np.take(above, [-1], axis)], axis)
    covered = occupancy > TAU
    for axis in range(covered.ndim):  # a piece between nodes is covered by any of its corners, its border with it
        covered |= np.roll(covered, 1, axis) | np.roll(covered, -1, axis)
    if not covered.any():
        return np.full(covered.shape, 1e4, np.float32)
    away = distance_transform_edt(~covered) - 0.5 * np.sqrt(covered.ndim) - 1e-3  # nodes; the slack is rounding's
    return (away / (fine * STEP)).astype(np.float32)


class Rays(eqx.Module):
    """Rays in the units of a field: point ``start + k stride`` is sample ``k``."""

    which: Int[Array, "rays"]  # the map that a ray runs through
    start: Coordinates  # cells
    stride: Coordinates  # cells a sample
    inverse_length: Float[Array, "rays"]  # of a metre of z-depth, 1/m
    last: Float[Array, "rays"]  # sample inside box and range


@partial(jax.jit, static_argnames="narrowing")
def depths(
    field: RayField,
    which: Int[Array, "rays"],
    centre: Coordinates,
    direction: Coordinates,
    max_depth: float | Array,
    narrowing: tuple[int, ...] = NARROWING,
) -> Float[Array, "rays"]:
    """z-depth (m) of the first surface along each ray up to ``max_depth``; 0 where there is none.

    Args:
        field: boxes.
        which: the map that a ray runs through.
        centre: world coordinates of where it starts, m, each ``(rays,)``.
        direction: of one metre of z-depth, at least 1 long, each ``(rays,)``.
        max_depth: m.
        narrowing: see :data:`NARROWING`.
    """
    rays, k = rays_of(field, which, centre, direction, max_depth)
    return STEP * field.voxel_size * surface(field, rays, k, narrowing)


def rays_of(
    field: RayField, which: Int[Array, "rays"], centre: Coordinates, direction: Coordinates, max_depth: float | Array
) -> tuple[Rays, Float[Array, "rays"]]:
    """Rays in the field's units, and the first sample of each that may hit; arguments as of :func:`depths`."""
    start = tuple((c - o) / field.voxel_size for c, o in zip(centre, field.origin, strict=True))
    stride = tuple(t * STEP for t in direction)
    inverse_length = jax.lax.rsqrt(sum(t * t for t in direction))
    range_ = jnp.floor(max_depth / (STEP * field.voxel_size))
    first, last = jnp.full(which.shape, FIRST), jnp.broadcast_to(range_, which.shape)
    for s, t, n in zip(start, stride, field.shape, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
        near, far = -s * inverse, (n - 1.0 - s) * inverse
        first, last = jnp.maximum(first, jnp.minimum(near, far)), jnp.minimum(last, jnp.maximum(near, far))
    # The slack keeps a sample on the box's face. A ray beside the box that runs along it ends at -1e9 or so, a number
    # that float32 cannot count up from.
    k, last = jnp.ceil(first - 1e-3), jnp.maximum(jnp.floor(last + 1e-3), -1.0)
    return Rays(which, start, stride, inverse_length, last), jnp.minimum(k, last + 1.0)


def surface(
    field: RayField, rays: Rays, k: Float[Array, "rays"], narrowing: tuple[int, ...] = NARROWING
) -> Float[Array, "rays"]:
    """Where rays that are free before sample ``k`` meet the first surface, in samples; 0 where they meet none."""
    found = _search(field, rays, k, narrowing)
    hit = found >= HIT
    k = jnp.where(hit, found - HIT, FIRST)
    o_k, o_before = (_value(field, rays.which, rays.start, rays.stride, at) for at in (k, k - 1.0))
    o_before = jnp.where(k > FIRST, o_before, jnp.minimum(o_before, TAU))  # the first sample never counts as a hit
    rise = o_k - o_before
    a = jnp.where(rise > 1e-9, (TAU - o_before) / jnp.where(rise > 1e-9, rise, 1.0), 1.0)
    return jnp.where(hit, k - 1.0 + a, 0.0)


def few(n: int, share: int) -> int:
    """One in ``share`` of n rays, and somewhat more."""
    return min(n, -(-n // (share * LEAST)) * LEAST)


def _search(field: RayField, rays: Rays, k: Array, narrowing: tuple[int, ...]) -> Array:
    """``k`` (+ HIT) of each ray; beyond ``last`` where there is none."""
    n = k.shape[0]
    for _ in range(FLIGHT):
        k = _leap(field, rays, k)
    index, found = jnp.arange(n), k
    for narrow in (*(few(n, share) for share in narrowing if n >= share * LEAST), 0):

        def advance(k, rays=rays):
            return _look(field, rays, _leap(field, rays, _leap(field, rays, k)))

        def crowded(k, rays=rays, narrow=narrow):
            return jnp.sum(k <= rays.last) > narrow

        k = jax.lax.while_loop(crowded, advance, k)
        found = k if k.shape[0] == n else found.at[index].set(k, mode="drop")
        if narrow:
            keep = first_set(k <= rays.last, narrow)
            index = index.at[keep].get(mode="fill", fill_value=n)
            rays, k = jax.tree.map(lambda a, keep=keep: a.at[keep].get(mode="clip"), (rays, k))
            rays = eqx.tree_at(lambda r: r.last, rays, jnp.where(index < n, rays.last, -1.0))
    return found


def _leap(field: RayField, rays: Rays, k: Array) -> Array:
    """Past all samples that cannot hit; where a sample might, it stays."""
    *strides, per_map = field.strides(field.fine)
    node = rays.which * per_map
    for s, t, n, stride in zip(rays.start, rays.stride, field.shape, strides, strict=True):
        at = ((s + t * k) * field.fine + 0.5).astype(jnp.int32)
        node += jnp.clip(at, 0, (n - 1) * field.fine) * stride
    reach = field.reach.at[node].get(mode="promise_in_bounds")
    further = k + jnp.floor(reach * rays.inverse_length) + 1.0
    return jnp.where((reach >= 0.0) & (k <= rays.last), further, k)


def _look(field: RayField, rays: Rays, k: Array) -> Array:
    """Test every sample that a ray has in its present cell: the first one above the threshold is the hit."""
    cell, _, corners = _corners(field, rays.which, rays.start, rays.stride, k)
    exits = jnp.full(k.shape, HIT)
    for s, t, c in zip(rays.start, rays.stride, cell, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
        exits = jnp.minimum(exits, (c + (inverse > 0) - s) * inverse)
    beyond = jnp.minimum(jnp.maximum(jnp.floor(exits), k) + 1.0, rays.last + 1.0)
    samples = int(np.sqrt(len(field.shape)) / STEP) + 1
    following = beyond
    for i in reversed(range(samples)):
        at = k + i
        fractions = [s + t * at - c for s, t, c in zip(rays.start, rays.stride, cell, strict=True)]
        following = jnp.where((_multilinear(corners, fractions) > TAU) & (at < beyond), at + HIT, following)
    return jnp.where(k <= rays.last, following, k)


def _value(field: RayField, which: Array, start: Coordinates, stride: Coordinates, k: Array) -> Array:
    """Occupancy at sample ``k``."""
    _, fractions, corners = _corners(field, which, start, stride, k)
    return _multilinear(corners, fractions)


def _corners(
    field: RayField, which: Array, start: Coordinates, stride: Coordinates, k: Array
) -> tuple[list[Array], list[Array], list[Array]]:
    """The cell of sample ``k``, the fractions in it, and the occupancies of its corners, last axis fastest."""
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
    """Interpolation between ``2^dims`` corners, last axis fastest, at fractions in [0, 1]."""
    for f in reversed(fractions):
        corners = [a + f * (b - a) for a, b in zip(corners[0::2], corners[1::2], strict=True)]
    return corners[0]
