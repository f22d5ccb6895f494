"""Many rays at once through pieces of a belief: the emission's own depths, found in fewer steps.

Along a ray ``p(d) = c + d t`` (d in metres of z-depth) the emission takes samples at ``d_k = k e``, e = 0.4 voxels,
finds the first ``k > 1`` whose occupancy is above zero and puts the surface where the linear interpolation of samples
``k - 1`` and ``k`` crosses zero (:mod:`vssm_gym.emission`). Here the same ``k`` is found by sphere tracing:

    reach(q) = distance from the node q to the nearest piece between nodes that has a corner above zero, less half a
               piece's diagonal

so that no sample within ``reach`` of any point nearest to q can hit. Nodes lie ``fine`` to a cell: a multilinear field
is largest at the corners of a piece, so pieces without a node above zero are certified. In the plane of the camera,
where a horizontal ray stays, a table of cones goes further in one look-up:

    sight(q, a) = largest s so that every ray that starts within half a diagonal of q in a direction within half a bin
                  of a is certified free up to s

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
BINS, COARSE = 128, 2  # directions of the table of cones, and cells between its nodes
NARROWING = (2, 8, 32)  # rays are gathered when so small a share of them is left: a few that graze hold up no others
LEAST = 256  # rays: fewer are not worth gathering
Coordinates = tuple[Array, ...]  # one array a coordinate: what runs over an axis of two or three does not vectorise


class RayField(eqx.Module):
    """Boxes of equal shape cut from one or several maps; see the module."""

    occupancy: Float[Array, "cells"]  # (maps, *shape) in C order, m
    reach: Float[Array, "nodes"]  # (maps, *nodes) in C order, samples of a ray of unit length
    origin: Float[Array, "dims"]  # world position of the centre of cell 0, m
    voxel_size: Float[Array, ""]  # m
    sight: Float[Array, "cones"] | None  # (maps, *coarse nodes, BINS) in C order, as reach; planar fields only
    shape: tuple[int, ...] = eqx.field(static=True)  # cells along each axis
    fine: int = eqx.field(static=True)  # nodes a cell

    @classmethod
    def cut(
        cls, occupancy: Float[np.ndarray, "maps *shape"], origin: np.ndarray, voxel: float, fine: int
    ) -> "RayField":
        """From the occupancies at cell centres, m."""
        shape = occupancy.shape[1:]
        reach = [_reach(one, fine) for one in occupancy]
        sight = None
        if len(shape) == 2:
            sight = jnp.concatenate([_sight(jnp.asarray(one, jnp.float32), shape, fine).reshape(-1) for one in reach])
        return cls(
            jnp.asarray(occupancy.reshape(-1), jnp.float32),
            jnp.asarray(np.stack(reach).reshape(-1), jnp.float32),
            jnp.asarray(origin, jnp.float32),
            jnp.asarray(voxel, jnp.float32),
            sight,
            shape,
            fine,
        )

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


@partial(jax.jit, static_argnums=(1, 2))
def _sight(reach: Float[Array, "nx ny"], shape: tuple[int, ...], fine: int) -> Float[Array, "x y bins"]:
    """The table of cones of one map: marched along its middle while the widening cone is free."""
    x, y = jnp.meshgrid(*(COARSE * jnp.arange((n - 1) // COARSE + 1.0) for n in shape), indexing="ij")
    angle = (jnp.arange(BINS) + 0.5) * (2.0 * jnp.pi / BINS)
    across, widening = 0.5 * np.sqrt(2.0) * COARSE + 1e-3, np.pi / BINS + 1e-5

    def march(towards):
        def free(s):  # certified around the middle at s, cells
            at = [p + s * t for p, t in zip((x, y), towards, strict=True)]
            node = [
                jnp.clip((p * fine + 0.5).astype(jnp.int32), 0, m - 1) for p, m in zip(at, reach.shape, strict=True)
            ]
            return STEP * reach[node[0], node[1]]

        def advance(s):
            return s + jnp.maximum(free(s) - across - s * widening, 0.0) / (1.0 + widening)

        return jax.lax.fori_loop(0, 24, lambda _, s: advance(s), jnp.zeros(x.shape))

    cones = jax.lax.map(march, (jnp.cos(angle), jnp.sin(angle)))
    return jnp.moveaxis(cones, 0, -1) / STEP


@partial(jax.jit, static_argnames="narrowing")
def depths(
    field: RayField,
    which: Int[Array, "rays"],
    centre: Coordinates,
    direction: Coordinates,
    max_depth: float | Array,
    angle: Float[Array, "rays"] | None = None,
    narrowing: tuple[int, ...] = NARROWING,
) -> Float[Array, "rays"]:
    """z-depth (m) of the first surface along each ray up to ``max_depth``; 0 where there is none.

    Args:
        field: boxes.
        which: the map that a ray runs through.
        centre: world coordinates of where it starts, m, each ``(rays,)``.
        direction: of one metre of z-depth, at least 1 long, each ``(rays,)``.
        max_depth: m.
        angle: of the directions, rad, world frame; for a planar field.
        narrowing: see :data:`NARROWING`.
    """
    e = STEP * field.voxel_size
    start = tuple((c - o) / field.voxel_size for c, o in zip(centre, field.origin, strict=True))
    stride = tuple(t * STEP for t in direction)
    inverse_length = jax.lax.rsqrt(sum(t * t for t in direction))
    first, last = jnp.full(which.shape, FIRST), jnp.broadcast_to(jnp.floor(max_depth / e), which.shape)
    for s, t, n in zip(start, stride, field.shape, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(t) > 1e-9, t, 1e-9)
        near, far = -s * inverse, (n - 1.0 - s) * inverse
        first, last = jnp.maximum(first, jnp.minimum(near, far)), jnp.minimum(last, jnp.maximum(near, far))
    # The slack keeps a sample on the box's face.
    k, last = jnp.ceil(first - 1e-3), jnp.floor(last + 1e-3)
    rays, k = _Rays(which, start, stride, inverse_length, last), jnp.minimum(k, last + 1.0)
    if angle is not None and field.sight is not None:
        k = _glide(field, rays, angle, _glide(field, rays, angle, k))
    found = _search(field, rays, k, narrowing)
    hit = found >= HIT
    k = jnp.where(hit, found - HIT, FIRST)
    o_k, o_before = (_value(field, which, start, stride, at) for at in (k, k - 1.0))
    o_before = jnp.where(k > FIRST, o_before, jnp.minimum(o_before, TAU))  # the first sample never counts as a hit
    rise = o_k - o_before
    a = jnp.where(rise > 1e-9, (TAU - o_before) / jnp.where(rise > 1e-9, rise, 1.0), 1.0)
    return jnp.where(hit, (k - 1.0 + a) * e, 0.0)


class _Rays(eqx.Module):
    which: Array
    start: Coordinates  # cells
    stride: Coordinates  # cells a sample
    inverse_length: Array  # of a metre of z-depth, 1/m
    last: Array  # sample inside box and range


def _search(field: RayField, rays: _Rays, k: Array, narrowing: tuple[int, ...]) -> Array:
    """``k`` (+ HIT) of each ray; beyond ``last`` where there is none."""
    n = k.shape[0]
    for _ in range(FLIGHT):
        k = _leap(field, rays, k)
    index, found = jnp.arange(n), k
    for narrow in (*(-(-n // share) for share in narrowing if n >= share * LEAST), 0):

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


def _glide(field: RayField, rays: _Rays, angle: Array, k: Array) -> Array:
    """Past all samples that the table of cones certifies."""
    assert field.sight is not None
    bins = (jnp.mod(angle * (1.0 / (2.0 * jnp.pi)), 1.0) * BINS).astype(jnp.int32)
    sizes = [(n - 1) // COARSE + 1 for n in field.shape]
    node = rays.which
    for s, t, size in zip(rays.start, rays.stride, sizes, strict=True):
        at = ((s + t * k) * (1.0 / COARSE) + 0.5).astype(jnp.int32)
        node = node * size + jnp.clip(at, 0, size - 1)
    sight = field.sight.at[node * BINS + jnp.minimum(bins, BINS - 1)].get(mode="promise_in_bounds")
    further = k + jnp.floor(sight * rays.inverse_length) + 1.0
    return jnp.where((sight > 0.0) & (k <= rays.last), further, k)


def _leap(field: RayField, rays: _Rays, k: Array) -> Array:
    """Past all samples that cannot hit; where a sample might, it stays."""
    *strides, per_map = field.strides(field.fine)
    node = rays.which * per_map
    for s, t, n, stride in zip(rays.start, rays.stride, field.shape, strides, strict=True):
        at = ((s + t * k) * field.fine + 0.5).astype(jnp.int32)
        node += jnp.clip(at, 0, (n - 1) * field.fine) * stride
    reach = field.reach.at[node].get(mode="promise_in_bounds")
    further = k + jnp.floor(reach * rays.inverse_length) + 1.0
    return jnp.where((reach >= 0.0) & (k <= rays.last), further, k)


def _look(field: RayField, rays: _Rays, k: Array) -> Array:
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
