"""The emission: ``p(x | z, M) = Laplace(x; mu_rgbd(z, M), diag(sigma_E))``, a differentiable RGB-D renderer (SPEC 1).

Along the ray of pixel (i, j), ``p(d) = c + d R K^-1 [i, j, 1]^T`` is sampled at ``d_k = k e``. With ``k`` the first
sample whose occupancy exceeds ``tau``, the surface is at ``d* = a d_k + (1 - a) d_k-1``,
``a = (tau - o_k-1) / (o_k - o_k-1)``, and the colour is the field there. The search for ``k`` has no gradient; the
interpolation at the hit has one in the map, the pose and the intrinsics. :func:`march` is the search as published;
:func:`search` finds the same ``k`` by skipping certified empty boxes (:mod:`vssm_gym.empty_space`).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.camera import Camera
from vssm_gym.empty_space import BLOCK, axis_offsets, corner_offsets
from vssm_gym.voxel_map import VoxelMap, trilinear

TAU = 0.0  # occupancy of the surface: zero for signed distances
STEP = 0.4  # e, in voxels (PRISM)
MAX_DEPTH = 8.0  # m
FLIGHT = 4  # leaps before the first look: rays start in the open
KNOWN_SHARE = 0.75  # a pixel is known where so much of its value comes from observed cells
SAMPLES_IN_CUBE = 5  # a ray crosses a cube's diagonal, sqrt(3) voxels, in at most floor(sqrt(3) / STEP) + 1 samples


class RGBD(eqx.Module):
    """An RGB-D image of the model."""

    depth: Float[Array, "height width"]  # z-depth, m; 0 where there is none
    rgb: Float[Array, "height width 3"]  # [0, 1]
    hit: Bool[Array, "height width"]  # where depth means anything
    known: Bool[Array, "height width"]  # where the surface has been observed: elsewhere the map only guesses


class EmissionScales(eqx.Module):
    """``sigma_E``: scales of the Laplace emission; colour is 10 times narrower than depth by default (SPEC 1)."""

    depth: Float[Array, ""] | float = 0.1  # m
    rgb: Float[Array, ""] | float = 0.01  # [0, 1]


class _Rays(NamedTuple):
    """Rays in cell coordinates: position ``start + k * stride`` at sample ``k``.

    One array a coordinate: a reduction over an axis of three keeps the compiler from vectorising over rays.
    """

    start: tuple[Array, ...]
    stride: tuple[Array, ...]  # cells a sample
    inverse: tuple[Array, ...]  # 1 / stride, finite where the ray is parallel to a face
    k: Array  # (rays,) the sample the search stands at
    last: Array  # (rays,) the last sample inside the grid and the depth range
    hit: Array  # (rays,)


def world_rays(T_world_cam: Float[Array, "4 4"], camera: Camera) -> tuple[Array, Array]:
    """Camera centre (3,) and ray directions (height*width, 3) in the world, per metre of z-depth."""
    directions = camera.rays().reshape(-1, 3) @ T_world_cam[:3, :3].T
    return T_world_cam[:3, 3], directions


def march(m: VoxelMap, centre: Array, directions: Array, max_depth: float | Array = MAX_DEPTH) -> tuple[Array, Array]:
    """The published search: every sample of every ray in order. The reference that :func:`search` is held to.

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
    _, found, first = jax.lax.while_loop(lambda c: c[0] <= count, advance, (jnp.int32(1), zero > 0, zero))
    return first, found


def _start(m: VoxelMap, centre: Array, directions: Array, max_depth: float | Array) -> _Rays:
    e = STEP * m.voxel_size
    origin = m.to_grid(centre)
    start = tuple(jnp.broadcast_to(origin[a], directions.shape[:1]) for a in range(3))
    stride = tuple(directions[:, a] * (e / m.voxel_size) for a in range(3))
    inverse = tuple(1.0 / jnp.where(jnp.abs(s) > 1e-9, s, 1e-9) for s in stride)
    enter, leave = jnp.full(directions.shape[:1], 2.0), jnp.broadcast_to(jnp.floor(max_depth / e), directions.shape[:1])
    for s, i, n in zip(start, inverse, m.shape, strict=True):
        near, far = -s * i, (n - 1.0 - s) * i
        enter = jnp.maximum(enter, jnp.minimum(near, far))
        leave = jnp.minimum(leave, jnp.maximum(near, far))
    # The slack keeps a sample on the grid's face; a ray beside the grid "enters" at 1e9 samples, which fits no int32.
    k = jnp.minimum(jnp.ceil(enter - 1e-3), jnp.floor(max_depth / e) + 1.0)
    last = jnp.where(enter > leave, 0.0, jnp.floor(leave + 1e-3))
    return _Rays(start, stride, inverse, k.astype(jnp.int32), last.astype(jnp.int32), jnp.zeros(k.shape, bool))


def _cube(m: VoxelMap, rays: _Rays) -> list[Array]:
    """The cube each ray's sample lies in, by coordinate; samples off the grid by rounding take the nearest one."""
    k = rays.k.astype(jnp.float32)
    at = (jnp.floor(start + stride * k) for start, stride in zip(rays.start, rays.stride, strict=True))
    return [jnp.clip(p.astype(jnp.int32), 0, n - 2) for p, n in zip(at, m.shape, strict=True)]


def _beyond(rays: _Rays, low: list[Array], size: Array | int) -> Array:
    """The first sample past the box from ``low`` to ``low + size``, at least one further than now."""
    exits = [
        (jnp.where(inverse > 0, edge + size, edge) - start) * inverse
        for start, inverse, edge in zip(rays.start, rays.inverse, low, strict=True)
    ]
    first = jnp.minimum(jnp.minimum(exits[0], exits[1]), exits[2])
    return jnp.maximum(jnp.floor(first).astype(jnp.int32), rays.k) + 1


def _leap(m: VoxelMap, rays: _Rays) -> _Rays:
    """Move each ray to the first sample beyond the certified empty box it stands in; not where its cube is occupied."""
    cube = _cube(m, rays)
    block = ((cube[0] >> 3) * m.blocks[1] + (cube[1] >> 3)) * m.blocks[2] + (cube[2] >> 3)
    rings = m.empty.rings.reshape(-1).at[block].get(mode="promise_in_bounds")
    flat = sum(axis_offsets(cube[0], cube[1], cube[2], m.blocks))
    level = m.empty.level.reshape(-1).at[flat].get(mode="promise_in_bounds").astype(jnp.int32)
    shift = jnp.where(rings > 0, 3, jnp.maximum(level - 1, 0))
    reach = jnp.where(rings > 0, (rings - 1) * BLOCK, 0)
    low = [((c >> shift) << shift) - reach for c in cube]
    beyond = _beyond(rays, low, (1 << shift) + 2 * reach)
    return rays._replace(k=jnp.where((level > 0) & ~rays.hit, beyond, rays.k))


def _look(m: VoxelMap, rays: _Rays) -> _Rays:
    """Test every sample that a ray has in its present cube: the first one above the threshold is the hit."""
    cube = _cube(m, rays)
    occupancy = m.occupancy.reshape(-1)
    offsets = corner_offsets(cube[0], cube[1], cube[2], m.blocks)
    corners = [occupancy.at[offset].get(mode="promise_in_bounds") for offset in offsets]
    beyond = jnp.minimum(_beyond(rays, cube, 1), rays.last + 1)
    hit, k = rays.hit, jnp.where(rays.hit, rays.k, beyond)
    for sample in reversed(range(SAMPLES_IN_CUBE)):
        at = rays.k + sample
        d = at.astype(jnp.float32)
        x, y, z = (s + t * d - c for s, t, c in zip(rays.start, rays.stride, cube, strict=True))
        above = (trilinear(corners, x, y, z) > TAU) & (at < beyond) & ~rays.hit
        hit, k = hit | above, jnp.where(above, at, k)
    return rays._replace(k=k, hit=hit)


def search(m: VoxelMap, centre: Array, directions: Array, max_depth: float | Array = MAX_DEPTH) -> tuple[Array, Array]:
    """First sample above the threshold, as :func:`march` finds it, skipping certified empty boxes.

    The two form positions in other units, so where a sample meets the threshold to the last bits (one ray in 10^5 of a
    learned map) they may differ by one sample; the crossing between samples, hence the depth, is continuous there.

    Rays move in lock step, so a few that graze a surface would hold up all others: whenever few are left they are
    gathered into a narrower batch. ``directions`` are at least 1 long, as those of a camera per metre of z-depth are:
    shorter ones would have more samples in a cube than are looked at.

    Returns:
        ``k`` (rays,) and ``hit`` (rays,).
    """
    n = directions.shape[0]
    rays = _start(m, centre, directions, max_depth)
    index = jnp.arange(n)
    done_k, done_hit = jnp.zeros(n, jnp.int32), jnp.zeros(n, bool)
    for _ in range(FLIGHT):
        rays = _leap(m, rays)
    widths = [n, *(-(-n // share) for share in (2, 4, 8, 16, 32, 64)), 0]
    for narrow in widths[1:]:

        def unfinished(rays):
            return (rays.k <= rays.last) & ~rays.hit

        def advance(rays):
            return _look(m, _leap(m, _leap(m, rays)))

        def crowded(rays, narrow=narrow):
            return jnp.sum(unfinished(rays)) > narrow

        rays = jax.lax.while_loop(crowded, advance, rays)
        done_k = done_k.at[index].set(rays.k, mode="drop")
        done_hit = done_hit.at[index].set(rays.hit, mode="drop")
        if narrow:
            (keep,) = jnp.nonzero(unfinished(rays), size=narrow, fill_value=rays.k.shape[0])
            index = index.at[keep].get(mode="fill", fill_value=n)
            rays = jax.tree.map(lambda a, keep=keep: a.at[keep].get(mode="clip"), rays)
            rays = rays._replace(last=jnp.where(index < n, rays.last, -1))
    return done_k, done_hit


def intersect(m: VoxelMap, centre: Array, directions: Array, k: Int[Array, "rays"]) -> Float[Array, "rays"]:
    """``d* = a d_k + (1 - a) d_k-1``: z-depth of the crossing before sample ``k``; differentiable, see the module."""
    e = STEP * m.voxel_size
    d_k = k.astype(jnp.float32) * e
    d_before = d_k - e
    o_k = m.occupancy_at(centre + directions * d_k[:, None])
    o_before = m.occupancy_at(centre + directions * d_before[:, None])
    o_before = jnp.where(k > 2, o_before, jnp.minimum(o_before, TAU))  # the first sample never counts as a hit
    rise = o_k - o_before
    a = (TAU - o_before) / jnp.where(rise > 1e-9, rise, 1.0)
    return jnp.where(rise > 1e-9, a * d_k + (1.0 - a) * d_before, d_k)


def render_with(
    searcher: Callable[..., tuple[Array, Array]],
    m: VoxelMap,
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    max_depth: float | Array = MAX_DEPTH,
) -> RGBD:
    """:func:`render` with a given search (``march`` or ``search``)."""
    centre, directions = world_rays(T_world_cam, camera)
    k, hit = searcher(*jax.lax.stop_gradient((m, centre, directions)), max_depth)
    k = jnp.where(hit, k, 2)
    depth = intersect(m, centre, directions, k)
    surface = centre + directions * depth[:, None]
    rgb = m.field(surface)[..., 1:]
    known = hit & (m.observed_at(jax.lax.stop_gradient(surface)) >= KNOWN_SHARE)
    shape = (camera.height, camera.width)
    depth = jnp.where(hit, depth, 0.0).reshape(shape)
    rgb = jnp.where(hit[:, None], rgb, 0.0).reshape(*shape, 3)
    return RGBD(depth, rgb, hit.reshape(shape), known.reshape(shape))


@jax.jit
def render(m: VoxelMap, T_world_cam: Float[Array, "4 4"], camera: Camera, max_depth: float | Array = MAX_DEPTH) -> RGBD:
    """``mu_rgbd(z, M)``: the RGB-D image of the mean map from a pose.

    Args:
        m: The map.
        T_world_cam: ``(4, 4)`` camera pose.
        camera: Intrinsics and image size.
        max_depth: z-depth (m) up to which surfaces are looked for.

    Returns:
        Depth (z, metres), colour, and the masks of pixels that hit a surface and that hit an observed one.
    """
    return render_with(search, m, T_world_cam, camera, max_depth)


def log_prob(image: RGBD, predicted: RGBD, scales: EmissionScales) -> Float[Array, "height width"]:
    """``log p(x | z, M)`` per pixel: Laplace in depth and RGB; pixels without depth on either side contribute 0."""
    valid = image.hit & predicted.hit
    depth = -jnp.abs(image.depth - predicted.depth) / scales.depth - jnp.log(2.0 * scales.depth)
    rgb = -jnp.abs(image.rgb - predicted.rgb) / scales.rgb - jnp.log(2.0 * scales.rgb)
    return jnp.where(valid, depth + rgb.sum(-1), 0.0)
