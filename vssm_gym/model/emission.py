"""Render RGB-D images differentiably: ``mu_rgbd(z, M)``, the location of ``p(x | z, M)`` (VSSM-LM, PRISM).

Along the ray of pixel (i, j), ``p(d) = c + d R K^-1 [i, j, 1]^T`` is sampled at ``d_k = k e``. With ``k`` the first
sample whose occupancy exceeds ``tau``, the surface is at ``d* = a d_k + (1 - a) d_k-1``,
``a = (tau - o_k-1) / (o_k - o_k-1)``, and the colour is the field there. The search for ``k`` has no gradient; the
interpolation at the hit has one in the map, the pose and the intrinsics. :func:`march` is the search as published;
:func:`search` finds the same ``k`` by skipping certified empty boxes (:mod:`vssm_gym.maps.empty_space`). The density of
an image about a rendered one is in :mod:`vssm_gym.model.emission_density`.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.maps.block_table import BLOCK, block_number, cell_offset, corner_offsets
from vssm_gym.maps.compaction import first_set
from vssm_gym.maps.voxel_map import VoxelMap, trilinear

TAU = 0.0  # occupancy of the surface: zero for signed distances
STEP = 0.4  # e, in voxels (PRISM)
HIT = 1 << 20  # added to the sample of a hit; no ray has as many samples
NARROWING = (2, 4, 8, 16, 32, 64)  # divisors of the number of rays: sizes of ever narrower batches
FLIGHT = 3  # leaps before the first test of a cube: rays start in free space
KNOWN_SHARE = 0.75  # a pixel is known where observed cells have at least this interpolation weight
SAMPLES_IN_CUBE = int(3**0.5 / STEP) + 1  # at most, of a ray along a cube's diagonal of sqrt(3) voxels


class RGBD(eqx.Module):
    """Represent an RGB-D image of the model."""

    depth: Float[Array, "height width"]  # z-depth, m; 0 where there is none
    rgb: Float[Array, "height width 3"]  # [0, 1]
    hit: Bool[Array, "height width"]  # where a ray hit a surface; elsewhere depth and colour are 0
    known: Bool[Array, "height width"]  # where the surface was observed; elsewhere it follows from the prior mean

    @classmethod
    def from_camera(cls, rgb: np.ndarray, depth: np.ndarray) -> "RGBD":
        """Convert an image as a camera delivers it.

        Args:
            rgb: ``(height, width, 3)`` uint8.
            depth: ``(height, width)`` z-depth, m; 0 or not finite where there is no reading.

        Returns:
            The image with colour in [0, 1]; pixels with a reading are marked as hit and known.
        """
        metres = jnp.where(np.isfinite(depth), jnp.asarray(depth, jnp.float32), 0.0)
        return cls(metres, jnp.asarray(rgb, jnp.float32) / 255.0, metres > 0.0, metres > 0.0)


@runtime_checkable
class Field(Protocol):
    """Describe ``f_M: R^3 -> R^4`` on a grid: the mean of a :class:`VoxelMap`, or a draw of its cells."""

    @property
    def voxel_size(self) -> Array:
        """Return the edge of a cell, m."""

    def occupancy_at(self, p_world: Array) -> Array:
        """Return the occupancy (...) at points (..., 3), m."""

    def colour_at(self, p_world: Array) -> Array:
        """Return RGB (..., 3) in [0, 1] at points (..., 3)."""


class Hits(NamedTuple):
    """Hold what rays hit first."""

    depth: Float[Array, "rays"]  # z-depth, m; 0 where there is none
    rgb: Float[Array, "rays 3"]  # [0, 1]; 0 where there is none
    hit: Bool[Array, "rays"]
    surface: Float[Array, "rays 3"]  # m, world; read it at hits only


class _Rays(NamedTuple):
    """Hold rays in cell coordinates: position ``start + k * stride`` at sample ``k``.

    One array a coordinate: a reduction over an axis of three keeps the compiler from vectorising over rays. One array
    encodes both the position and the hit: the compiler repeats the whole computation for each array that a step
    writes, so that two arrays would cost twice as much.
    """

    start: tuple[Array, ...]  # scalars: all rays leave the camera
    stride: tuple[Array, ...]  # (rays,) cells a sample
    k: Array  # (rays,) the current sample of the search; plus HIT where it found the surface
    last: Array  # (rays,) the last sample inside the grid and the depth range

    @property
    def inverse(self) -> tuple[Array, ...]:
        """Return 1 / stride, finite where the ray is parallel to a face."""
        return tuple(1.0 / jnp.where(jnp.abs(s) > 1e-9, s, 1e-9) for s in self.stride)

    @property
    def unfinished(self) -> Array:
        """Return which rays neither hit nor left."""
        return self.k <= self.last


def world_rays(
    T_world_cam: Float[Array, "4 4"], camera: Camera, pixels: Int[Array, "rays"] | None = None
) -> tuple[Array, Array]:
    """Return the camera centre (3,) and ray directions (rays, 3) in the world, per metre of z-depth.

    Args:
        T_world_cam: pose of the camera.
        camera: intrinsics and image size.
        pixels: numbers of pixels, row by row; None: all of them.
    """
    # One array a coordinate: a product (N, 3) @ (3, 3) costs as much as a tenth of an image.
    if pixels is None:
        v, u = (a.reshape(-1) for a in jnp.indices((camera.height, camera.width), jnp.float32))
    else:
        v, u = (a.astype(jnp.float32) for a in (pixels // camera.width, pixels % camera.width))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    R = T_world_cam[:3, :3]
    directions = jnp.stack([R[a, 0] * x + R[a, 1] * y + R[a, 2] for a in range(3)], axis=-1)
    return T_world_cam[:3, 3], directions


def march(m: Field, centre: Array, directions: Array, max_depth: float | Array = MAX_DEPTH) -> tuple[Array, Array]:
    """Search every sample of every ray in order: the published search, to which :func:`search` is compared in tests.

    Returns:
        ``k`` (rays,), the first sample above the threshold, and ``hit`` (rays,).
    """
    e = STEP * m.voxel_size
    count = jnp.floor(max_depth / e).astype(jnp.int32)

    def advance(carry):
        k, found, first = carry
        p = centre + directions * (k.astype(jnp.float32) * e)
        above = (m.occupancy_at(p) > TAU) & (k > 1)
        first = jnp.where(above & ~found, k, first)
        return k + 1, found | above, first

    zero = jnp.zeros(directions.shape[:-1], jnp.int32)
    searching = lambda carry: (carry[0] <= count) & ~jnp.all(carry[1])
    _, found, first = jax.lax.while_loop(searching, advance, (jnp.int32(1), zero > 0, zero))
    return first, found


def _start(m: VoxelMap, centre: Array, directions: Array, max_depth: float | Array) -> _Rays:
    e = STEP * m.voxel_size
    origin = m.to_grid(centre)
    stride = tuple(directions[:, a] * (e / m.voxel_size) for a in range(3))
    nothing = jnp.zeros(directions.shape[:1], jnp.int32)
    rays = _Rays(tuple(origin), stride, nothing, nothing)
    enter, leave = jnp.full(directions.shape[:1], 2.0), jnp.broadcast_to(jnp.floor(max_depth / e), directions.shape[:1])
    for s, i, n in zip(rays.start, rays.inverse, m.shape, strict=True):
        near, far = -s * i, (n - 1.0 - s) * i
        enter = jnp.maximum(enter, jnp.minimum(near, far))
        leave = jnp.minimum(leave, jnp.maximum(near, far))
    # The slack keeps a sample on the grid's face. A ray that misses it "enters" at 1e9 samples, too large for int32.
    k = jnp.minimum(jnp.ceil(enter - 1e-3), jnp.floor(max_depth / e) + 1.0)
    last = jnp.where(enter > leave, 0.0, jnp.floor(leave + 1e-3))
    return rays._replace(k=k.astype(jnp.int32), last=last.astype(jnp.int32))


def _cube(m: VoxelMap, rays: _Rays) -> list[Array]:
    """Return the cube of each ray's sample, by coordinate; samples off the grid by rounding take the nearest one."""
    k = rays.k.astype(jnp.float32)
    at = (jnp.floor(start + stride * k) for start, stride in zip(rays.start, rays.stride, strict=True))
    return [jnp.clip(p.astype(jnp.int32), 0, n - 2) for p, n in zip(at, m.shape, strict=True)]


def _beyond(rays: _Rays, low: list[Array], size: Array | int) -> Array:
    """Return the first sample past the box from ``low`` to ``low + size``, at least one further than now."""
    exits = [
        (jnp.where(inverse > 0, edge + size, edge) - start) * inverse
        for start, inverse, edge in zip(rays.start, rays.inverse, low, strict=True)
    ]
    first = jnp.minimum(jnp.minimum(exits[0], exits[1]), exits[2])
    return jnp.maximum(jnp.floor(first).astype(jnp.int32), rays.k) + 1


def _leap(m: VoxelMap, rays: _Rays) -> _Rays:
    """Move each ray to the first sample beyond its certified empty box; rays in occupied cubes stay."""
    cube = _cube(m, rays)
    block = block_number([c >> 3 for c in cube], m.blocks)
    rings = m.empty.rings.reshape(-1).at[block].get(mode="promise_in_bounds").astype(jnp.int32)
    flat = cell_offset(cube, m.blocks, m.table)
    level = m.empty.level.reshape(-1).at[flat].get(mode="promise_in_bounds").astype(jnp.int32)
    shift = jnp.where(rings > 0, 3, jnp.maximum(level - 1, 0))
    reach = jnp.where(rings > 0, (rings - 1) * BLOCK, 0)
    low = [((c >> shift) << shift) - reach for c in cube]
    beyond = jnp.minimum(_beyond(rays, low, (1 << shift) + 2 * reach), HIT - 1)
    return rays._replace(k=jnp.where(((rings > 0) | (level > 0)) & (rays.k < HIT), beyond, rays.k))


def _look(m: VoxelMap, rays: _Rays) -> _Rays:
    """Test every sample of a ray in its current cube: the first one above the threshold is the hit."""
    cube = _cube(m, rays)
    occupancy = m.occupancy.reshape(-1)
    offsets = corner_offsets(cube, m.blocks, m.table)
    corners = [occupancy.at[offset].get(mode="promise_in_bounds") for offset in offsets]
    beyond = jnp.minimum(_beyond(rays, cube, 1), rays.last + 1)
    k = beyond
    for sample in reversed(range(SAMPLES_IN_CUBE)):
        at = rays.k + sample
        d = at.astype(jnp.float32)
        x, y, z = (s + t * d - c for s, t, c in zip(rays.start, rays.stride, cube, strict=True))
        k = jnp.where((trilinear(corners, x, y, z) > TAU) & (at < beyond), at + HIT, k)
    return rays._replace(k=jnp.where(rays.k < HIT, k, rays.k))


def search(m: VoxelMap, centre: Array, directions: Array, max_depth: float | Array = MAX_DEPTH) -> tuple[Array, Array]:
    """Find the first sample above the threshold, as :func:`march` does, but skip certified empty boxes (eq. M10).

    The two compute positions in different units. Where a sample equals the threshold to the last bits (one ray in 10^5
    of a learned map) they may differ by one sample; the crossing between samples, hence the depth, is continuous there.

    Rays move in lock step, so that a few that graze a surface would delay all others: when few are left they are
    gathered into a narrower batch. ``directions`` have length 1 at least, as those of a camera per metre of z-depth do:
    shorter ones would have more samples in a cube than are tested.

    Returns:
        ``k`` (rays,) and ``hit`` (rays,).
    """
    n = directions.shape[0]
    rays = _start(m, centre, directions, max_depth)
    for _ in range(FLIGHT):
        rays = _leap(m, rays)
    index, found = jnp.arange(n), rays.k
    for narrow in (*(-(-n // share) for share in NARROWING), 0):

        def advance(k, rays=rays):
            return _look(m, _leap(m, _leap(m, rays._replace(k=k)))).k

        def crowded(k, rays=rays, narrow=narrow):
            return jnp.sum(rays._replace(k=k).unfinished) > narrow

        rays = rays._replace(k=jax.lax.while_loop(crowded, advance, rays.k))
        found = rays.k if rays.k.shape[0] == n else found.at[index].set(rays.k, mode="drop")
        if narrow:
            keep = first_set(rays.unfinished, narrow)
            index = index.at[keep].get(mode="fill", fill_value=n)
            stride, k, last = jax.tree.map(lambda a, keep=keep: a.at[keep].get(mode="clip"), rays[1:])
            rays = _Rays(rays.start, stride, k, jnp.where(index < n, last, -1))
    hit = found >= HIT
    return jnp.where(hit, found - HIT, found), hit


def _along(centre: Array, directions: Array, depth: Array) -> Array:
    """Return points (rays, 3) at z-depths, computed one coordinate at a time."""
    return jnp.stack([centre[a] + directions[:, a] * depth for a in range(3)], axis=-1)


def intersect(m: Field, centre: Array, directions: Array, k: Int[Array, "rays"]) -> Float[Array, "rays"]:
    """``d* = a d_k + (1 - a) d_k-1``: the z-depth of the crossing before sample ``k``; differentiable (eq. M9)."""
    e = STEP * m.voxel_size
    d_k = k.astype(jnp.float32) * e
    d_before = d_k - e
    o_k = m.occupancy_at(_along(centre, directions, d_k))
    o_before = m.occupancy_at(_along(centre, directions, d_before))
    o_before = jnp.where(k > 2, o_before, jnp.minimum(o_before, TAU))  # the first sample never counts as a hit
    rise = o_k - o_before
    a = (TAU - o_before) / jnp.where(rise > 1e-9, rise, 1.0)
    return jnp.where(rise > 1e-9, a * d_k + (1.0 - a) * d_before, d_k)


def trace(
    searcher: Callable[..., tuple[Array, Array]],
    m: Field,
    centre: Float[Array, "3"],
    directions: Float[Array, "rays 3"],
    max_depth: float | Array = MAX_DEPTH,
) -> Hits:
    """Find the surface and its colour along rays, with a given search; differentiable but for the search (eq. M9).

    Args:
        searcher: ``march``, or ``search`` in a :class:`VoxelMap`.
        m: the field.
        centre: of the camera, m, world.
        directions: of the rays, per metre of z-depth.
        max_depth: z-depth up to which surfaces are searched, m.
    """
    k, hit = searcher(*jax.lax.stop_gradient((m, centre, directions)), max_depth)
    depth = intersect(m, centre, directions, jnp.where(hit, k, 2))
    surface = _along(centre, directions, depth)
    rgb = jnp.where(hit[:, None], m.colour_at(surface), 0.0)
    return Hits(jnp.where(hit, depth, 0.0), rgb, hit, surface)


def render_with(
    searcher: Callable[..., tuple[Array, Array]],
    m: VoxelMap,
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    max_depth: float | Array = MAX_DEPTH,
) -> RGBD:
    """Render as :func:`render`, with a given search (``march`` or ``search``)."""
    seen = trace(searcher, m, *world_rays(T_world_cam, camera), max_depth)
    known = seen.hit & (m.observed_at(jax.lax.stop_gradient(seen.surface)) >= KNOWN_SHARE)
    shape = (camera.height, camera.width)
    return RGBD(seen.depth.reshape(shape), seen.rgb.reshape(*shape, 3), seen.hit.reshape(shape), known.reshape(shape))


@jax.jit
def render(m: VoxelMap, T_world_cam: Float[Array, "4 4"], camera: Camera, max_depth: float | Array = MAX_DEPTH) -> RGBD:
    """Render ``mu_rgbd(z, M)``, the RGB-D image of the mean map from a pose (eq. M9).

    Args:
        m: The map.
        T_world_cam: ``(4, 4)`` camera pose.
        camera: Intrinsics and image size.
        max_depth: z-depth (m) up to which surfaces are searched.

    Returns:
        Depth (z, metres), colour, and the masks of pixels that hit a surface and that hit an observed one.
    """
    return render_with(search, m, T_world_cam, camera, max_depth)
