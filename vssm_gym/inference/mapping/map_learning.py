"""``min_M E[-log p(x | z, M)]``: learn the map through the renderer from random images and pixels (TNP-SM).

Learning starts from the closed-form map: an empty one renders nothing and has no gradient. Where a ray hits, ``-log p``
is that of Laplace noise in depth and colour,

    |d - d*(M)| / s_d + sum_c |x_c - f_c(p(d*))| / s_c,

with its gradient in the cells around the two samples of the crossing and in the colours around the surface. Colour does
not move the surface (``p(d*)`` is a constant to it): otherwise cells slide along the ray to a place of matching colour,
and held-out depth becomes worse. A ray that finds no surface, or one far behind the observed one, has no useful
gradient. Its depth error is linearised around the observed depth d, where a projective distance grows by one a metre:
``|f(p(d + e)) - e| / s_d`` at four e in the truncation band, and the colour error is taken at ``p(d)``.

The solver is plain stochastic gradient descent, preconditioned by the scales: ``M <- M - rate s dL/dM``. It reads and
writes only the cells that the drawn rays use, so that a step costs the same in a map of any size. There is no
regularisation: the prior p(M) (std 10 m) is far weaker than one ray, and the closed-form posterior was made from the
same images, so that a penalty towards it would count them twice. Precisions keep counting observations; the refined
means are no longer averages of observations.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.inference.mapping.views import Views, fit_scales
from vssm_gym.maps.voxel_map import TRUNCATION, VoxelMap, trilinear
from vssm_gym.model import emission
from vssm_gym.model.emission import MAX_DEPTH, STEP, TAU
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.progress import OnProgress

BAND_OFFSETS = (-1.5, -0.5, 0.5, 1.5)  # voxels around the observed depth, where a ray without a surface is given one


@dataclass(frozen=True)
class MapLearningConfig:
    """Configure batch, rates and effort."""

    images: int = 2  # drawn a step
    pixels: int = 512  # drawn of each
    occupancy_rate: float = 0.001  # m: change of a cell by one wrong ray whose depth depends on that cell alone
    colour_rate: float = 0.005  # likewise of a colour channel
    steps: int = 4000  # of refine; rates fall linearly to zero over them
    refresh: int = 100  # steps between rebuilds of the empty-space index
    truncation: float = TRUNCATION  # voxels: a surface found farther behind the observed one is another surface
    max_depth: float = MAX_DEPTH  # m; farther readings are left out


class MapLearningState(eqx.Module):
    """Hold the map between steps. Its empty-space index follows only at :func:`refresh`."""

    map: VoxelMap


class MapLearningInfo(eqx.Module):
    """Report means over the drawn pixels with a reading."""

    depth_l1: Float[Array, ""]  # m, of those with a surface
    colour_l1: Float[Array, ""]  # of those with a surface
    hit_share: Float[Array, ""]


class _DrawnRays(NamedTuple):
    """Hold drawn rays ``(rays,)`` and their observations."""

    centre: Array  # (rays, 3) world, m
    direction: Array  # (rays, 3) per metre of z-depth
    depth: Array  # (rays,) m
    rgb: Array  # (rays, 3) in [0, 1]
    k: Array  # (rays,) the sample behind the crossing
    near: Array  # (rays,) a surface was found, not far behind the observed one
    read: Array  # (rays,) the pixel has a reading

    def at(self, depth: Array) -> Array:
        """Return world points (rays, 3)."""
        return self.centre + self.direction * depth[:, None]


class _Cells(NamedTuple):
    """Hold, for points in the map, the storage positions of the eight cells around and the fractions between them."""

    offsets: Array  # (8, points)
    shared: Array  # (8, points) cells of blocks without storage, which hold the prior of them all: never written
    fraction: list[Array]
    inside: Array  # (points,) in the grid

    @classmethod
    def around(cls, m: VoxelMap, p_world: Array) -> "_Cells":
        offsets, fraction, inside = m.corners(p_world)
        at = jnp.stack(offsets)
        shared = jnp.zeros(at.shape, bool) if m.table is None else at < m.occupancy.shape[-1]
        return cls(at, shared, list(fraction), inside)

    def read(self, flat: Array) -> Array:
        return flat.at[self.offsets].get(mode="promise_in_bounds")

    def add(self, flat: Array, change: Array) -> Array:
        return flat.at[jnp.where(self.shared, flat.size, self.offsets)].add(change, mode="drop")

    def mix(self, values: Array) -> Array:
        """Interpolate the field at the points from values of their cells."""
        return trilinear(list(values), *self.fraction)


class _Values(NamedTuple):
    """Hold the values of the used cells; the loss is differentiated by these, never by the whole map."""

    crossing: Array  # (8, 2 rays)
    band: Array  # (8, BAND_OFFSETS rays)
    colour: tuple[Array, ...]  # (8, rays) of each channel


def init(m: VoxelMap) -> MapLearningState:
    """Start the refinement of ``m``, which is not consumed."""
    return MapLearningState(jax.tree.map(jnp.copy, m))


def _draw(m: VoxelMap, views: Views, config: MapLearningConfig, key: PRNGKeyArray) -> _DrawnRays:
    """Draw random pixels of random images, and search the map's surface along their rays."""
    of_image, of_pixel = jax.random.split(key)
    n, height, width = views.depth.shape
    image = jax.random.randint(of_image, (config.images,), 0, n)
    pixel = jax.random.randint(of_pixel, (config.images, config.pixels), 0, height * width)

    def view(image, pixel):
        i, j = pixel % width, pixel // width
        x, y = (i - views.camera.cx) / views.camera.fx, (j - views.camera.cy) / views.camera.fy
        T = views.T_world_cam[image]
        direction = jnp.stack([T[a, 0] * x + T[a, 1] * y + T[a, 2] for a in range(3)], axis=-1)
        k, hit = emission.search(m, T[:3, 3], direction, config.max_depth)
        centre = jnp.broadcast_to(T[:3, 3], direction.shape)
        return centre, direction, views.depth[image, j, i], views.rgb[image, j, i], k, hit

    drawn = jax.lax.map(lambda a: view(*a), (image, pixel))  # the rays of a search share their centre
    centre, direction, depth, rgb, k, hit = (a.reshape(-1, *a.shape[2:]) for a in drawn)
    read = (depth > 0.0) & (depth <= config.max_depth)
    near = read & hit & (k * (STEP * m.voxel_size) - depth < config.truncation * m.voxel_size)
    return _DrawnRays(centre, direction, depth, rgb.astype(jnp.float32) / 255.0, jnp.where(near, k, 2), near, read)


def _crossing(m: VoxelMap, rays: _DrawnRays, occupancy: Array) -> Array:
    """Return ``d*`` from the occupancies (2 rays,) before and behind the crossing, as :func:`emission.intersect`."""
    before, behind = jnp.split(occupancy, 2)
    e = STEP * m.voxel_size
    d = rays.k.astype(jnp.float32) * e
    before = jnp.where(rays.k > 2, before, jnp.minimum(before, TAU))
    rise = behind - before
    a = (TAU - before) / jnp.where(rise > 1e-9, rise, 1.0)
    return jnp.where(rise > 1e-9, a * d + (1.0 - a) * (d - e), d)


def _step(
    state: MapLearningState, views: Views, config: MapLearningConfig, key: PRNGKeyArray, rate: float | Array
) -> tuple[MapLearningState, MapLearningInfo]:
    m = state.map
    rays = _draw(m, views, config, key)
    occupancy, colours = m.occupancy.reshape(-1), m.colour.reshape(-1)
    d_k, e = rays.k.astype(jnp.float32) * (STEP * m.voxel_size), STEP * m.voxel_size
    shifts = [b * m.voxel_size for b in BAND_OFFSETS]
    crossing = _Cells.around(m, jnp.concatenate([rays.at(d_k - e), rays.at(d_k)]))
    band = _Cells.around(m, jnp.concatenate([rays.at(rays.depth + b) for b in shifts]))
    depth = _crossing(m, rays, crossing.mix(crossing.read(occupancy)))
    surface = _Cells.around(m, rays.at(jnp.where(rays.near, depth, rays.depth)))
    # Of a row's three planes of cells the channel's is the c-th: o = row CELLS + cell -> (3 row + c) CELLS + cell.
    cells = m.occupancy.shape[-1]
    first = surface.offsets // cells * (3 * cells) + surface.offsets % cells
    channels = [surface._replace(offsets=first + c * cells) for c in range(3)]

    def loss(values: _Values) -> tuple[Array, tuple[Array, Array]]:
        """Return ``-log p`` times the scales, which the preconditioner would cancel, and the residuals."""
        off = jnp.abs(_crossing(m, rays, crossing.mix(values.crossing)) - rays.depth)
        off_band = jnp.abs(band.mix(values.band) - jnp.repeat(jnp.stack(shifts), rays.depth.size)) * band.inside
        off_band = off_band.reshape(len(BAND_OFFSETS), -1).sum(0)
        off_colour = sum(jnp.abs(surface.mix(v) - rays.rgb[:, c]) for c, v in enumerate(values.colour))
        off_colour = off_colour * (surface.inside & rays.read)
        geometry = jnp.where(rays.near, off, jnp.where(rays.read, off_band, 0.0))
        return jnp.sum(geometry) + jnp.sum(off_colour), (off, off_colour)

    values = _Values(crossing.read(occupancy), band.read(occupancy), tuple(c.read(colours) for c in channels))
    (_, (off, off_colour)), g = jax.value_and_grad(loss, has_aux=True)(values)
    down = -rate * config.occupancy_rate
    occupancy = band.add(crossing.add(occupancy, down * g.crossing), down * g.band)
    for channel, slope in zip(channels, g.colour, strict=True):
        colours = channel.add(colours, -rate * config.colour_rate * slope)
    means = (occupancy.reshape(m.occupancy.shape), colours.reshape(m.colour.shape))
    m = eqx.tree_at(lambda m: (m.occupancy, m.colour), m, means)
    hits = jnp.maximum(jnp.sum(rays.near), 1)
    depth_l1, colour_l1 = jnp.sum(off * rays.near) / hits, jnp.sum(off_colour * rays.near) / (3.0 * hits)
    info = MapLearningInfo(depth_l1, colour_l1, jnp.sum(rays.near) / jnp.maximum(jnp.sum(rays.read), 1))
    return MapLearningState(m), info


@partial(jax.jit, static_argnums=2, donate_argnums=0)
def step(
    state: MapLearningState, views: Views, config: MapLearningConfig, key: PRNGKeyArray, rate: float | Array = 1.0
) -> tuple[MapLearningState, MapLearningInfo]:
    """Make one step of gradient descent on ``-log p(x | z, M)`` of drawn pixels. The state passed in is consumed.

    Args:
        state: The map so far.
        views: Images that the batch is drawn from.
        config: Batch and rates.
        key: Of the draw.
        rate: Factor on all rates.
    """
    return _step(state, views, config, key, rate)


@partial(jax.jit, static_argnums=(2, 5), donate_argnums=0)
def _steps(
    state: MapLearningState,
    views: Views,
    config: MapLearningConfig,
    key: PRNGKeyArray,
    first: Int[Array, ""],
    count: int,
) -> tuple[MapLearningState, MapLearningInfo]:
    """Make ``count`` steps from number ``first`` of ``config.steps`` on; return the info of the last."""

    def body(i, carry):
        state, _ = carry
        rate = 1.0 - (first + i) / config.steps
        return _step(state, views, config, jax.random.fold_in(key, first + i), rate)

    zero = jnp.zeros(())
    return jax.lax.fori_loop(0, count, body, (state, MapLearningInfo(zero, zero, zero)))


def refresh(state: MapLearningState) -> MapLearningState:
    """Rebuild the empty-space index, so that rays find surfaces that grew in boxes marked empty before."""
    return MapLearningState(state.map.with_occupancy(state.map.occupancy))


def refine(
    m: VoxelMap,
    views: Views,
    config: MapLearningConfig,
    key: PRNGKeyArray,
    on_progress: OnProgress | None = None,
) -> tuple[VoxelMap, EmissionScales]:
    """Refine the map ``m`` (not consumed) by ``config.steps`` steps, with rates falling linearly to zero (eq. I39).

    Args:
        m: The closed-form map at the views' poses.
        views: Training images.
        config: Batch, rates, effort.
        key: Of the draws.
        on_progress: Called after every refresh.

    Returns:
        The refined map, its index up to date, and the emission scales that fit it best on the views.
    """
    state = init(m)
    done = 0
    while done < config.steps:
        count = min(config.refresh, config.steps - done)
        state, _ = _steps(state, views, config, key, jnp.asarray(done), count)
        state = refresh(state)
        done += count
        if on_progress:
            on_progress("refining the map", done, config.steps)
    return state.map, fit_scales(state.map, views, config.max_depth)
