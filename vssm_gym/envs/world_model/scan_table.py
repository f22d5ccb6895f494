"""Tabulate planar scans: the surface line that each cell of a planar field sees in each direction.

With q the centre of a cell, a line that does not pass through it is ``{x : m . (x - q) = 1}``, and a ray ``p + k t``
from anywhere in the cell meets it at

    k = (1 - m . (p - q)) / (m . t)

Nine rays are traced for each cell and each of ``BINS`` directions: from the cell's corners along both edges of the bin,
and from its centre along the middle. Their hits give the line (total least squares). Where it explains all nine to
within ``ACROSS_TOLERANCE``, rays of that cell and bin are taken to meet it: in a learned map of ``oak`` 86 % of all
rays, and all rays together are off by 0.2 mm (median) and 1.1 cm (99 %). Elsewhere, mostly at the edges of things, rays
are traced (:mod:`vssm_gym.envs.world_model.rays`) from one cell before the shortest of the nine. What is thinner than
the gaps between the nine, about half a cell, may be missed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.envs.world_model.rays import Coordinates, RayField, Rays, rays_of, subset_size, surface
from vssm_gym.maps.compaction import first_set
from vssm_gym.model.emission import STEP

BINS = 128  # of directions
ACROSS_TOLERANCE, ALONG_TOLERANCE = 0.4, 1.0  # cells: largest error of the nine hits across the line, and along the ray
UNSURE = 5  # one ray in UNSURE is traced in one pass: somewhat more than the rays without a line
ANYWHERE = 1e3  # m: beyond every box, so that rays are traced to its end
SURE = -1.0  # marks entries whose line holds


class ScanTable(eqx.Module):
    """Hold the table of one or several maps in the field's units, cells and samples; see the module."""

    m_x: Float[Array, "entries"]  # (maps, nx, ny, BINS) in C order, 1 / cells
    m_y: Float[Array, "entries"]
    start: Float[Array, "entries"]  # samples of a ray of unit length that are free; SURE where the line holds

    @classmethod
    def of(cls, field: RayField) -> "ScanTable":
        """Tabulate a planar field; this takes some seconds a map."""
        nx, ny = field.shape
        each = [_table_of_map(field, jnp.asarray(i, jnp.int32)) for i in range(field.occupancy.shape[0] // (nx * ny))]
        return cls(*(jnp.concatenate(parts) for parts in zip(*each, strict=True)))

    def look_up(
        self, field: RayField, rays: Rays, angle: Float[Array, "rays"]
    ) -> tuple[Float[Array, "rays"], Float[Array, "rays"], Bool[Array, "rays"]]:
        """Return where rays meet their line (samples), up to which sample they are free, and whether the line holds."""
        entry, away, inside = rays.which, [], jnp.ones(rays.which.shape, bool)
        for s, n in zip(rays.start, field.shape, strict=True):
            cell = jnp.clip(jnp.floor(s + 0.5), 0.0, n - 1.0)
            away.append(s - cell)
            inside &= jnp.abs(s - cell) <= 0.5
            entry = entry * n + cell.astype(jnp.int32)
        turns = angle * (1.0 / (2.0 * jnp.pi))
        bins = jnp.minimum(((turns - jnp.floor(turns)) * BINS).astype(jnp.int32), BINS - 1)
        entry = entry * BINS + bins
        m_x, m_y, start = (table.at[entry].get(mode="promise_in_bounds") for table in (self.m_x, self.m_y, self.start))
        (x, y), (t_x, t_y) = away, rays.stride
        met = (1.0 - m_x * x - m_y * y) / (m_x * t_x + m_y * t_y)  # no surface: m = 0, met at infinity
        return met, jnp.where(inside, start * rays.inverse_length, 0.0), inside & (start == SURE)


@jax.jit
def scan_depths(
    field: RayField,
    scan_table: ScanTable,
    which: Int[Array, "rays"],
    centre: Coordinates,
    direction: Coordinates,
    angle: Float[Array, "rays"],
    max_depth: float | Array,
) -> Float[Array, "rays"]:
    """Return the z-depth (m) of the first surface along each ray, 0 without one up to ``max_depth``.

    The table answers where it holds; the other rays are traced. Arguments are those of
    :func:`vssm_gym.envs.world_model.rays.rays_of` for a planar field; ``angle`` is the bearing of each ray in the world
    (rad).
    """
    rays, k = rays_of(field, which, centre, direction, max_depth)
    met, free, sure = scan_table.look_up(field, rays, angle)
    k = jnp.maximum(k, jnp.minimum(jnp.floor(free), rays.last + 1.0))
    n = which.shape[0]
    chunk = subset_size(n, UNSURE)

    def trace(carry):
        met, left = carry
        index = first_set(left, chunk)
        some, begin = jax.tree.map(lambda a: a.at[index].get(mode="clip"), (rays, k))
        some = eqx.tree_at(lambda r: r.last, some, jnp.where(index < n, some.last, -1.0))
        traced = surface(field, some, begin)
        return met.at[index].set(traced, mode="drop"), left.at[index].set(False, mode="drop")

    met = jnp.where((met > 0.0) & (met <= rays.last), met, 0.0)  # 1 / -0: at minus infinity
    met, _ = jax.lax.while_loop(lambda carry: jnp.any(carry[1]), trace, (met, ~sure))
    return STEP * field.voxel_size * met


@jax.jit
def _table_of_map(field: RayField, which: Int[Array, ""]) -> tuple[Array, Array, Array]:
    """Compute the table of one map, flat."""
    nx, ny = field.shape
    width = 2.0 * np.pi / BINS
    # Corner (i, j) is between the cells i - 1 and i. Where the box ends it is on the box's face.
    corners = [jnp.clip(jnp.arange(n + 1.0) - 0.5, 0.0, n - 1.0) for n in field.shape]
    corner_x, corner_y = jnp.meshgrid(*corners, indexing="ij")
    cell_x, cell_y = jnp.meshgrid(jnp.arange(float(nx)), jnp.arange(float(ny)), indexing="ij")

    spread = lambda a, like: jnp.broadcast_to(a, like.size)
    centre = tuple(
        jnp.concatenate([p.reshape(-1) for p in pair]) * field.voxel_size + o
        for pair, o in zip(((corner_x, cell_x), (corner_y, cell_y)), field.origin, strict=True)
    )

    def hits(number):
        """Trace from corners along the bin's first edge and from cells along its middle: samples to the hit, or 0."""
        edge, middle = number * width, (number + 0.5) * width
        angle = jnp.concatenate([spread(edge, corner_x), spread(middle, cell_x)])
        rays, k = rays_of(field, spread(which, angle), centre, (jnp.cos(angle), jnp.sin(angle)), ANYWHERE)
        met = surface(field, rays, k)
        return met[: corner_x.size].reshape(corner_x.shape), met[corner_x.size :].reshape(cell_x.shape)

    numbers = jnp.arange(float(BINS))
    from_corners, from_cells = jax.lax.map(hits, numbers)

    def entries(bin_):
        number, first, second, middle = bin_
        traced = [(middle, (number + 0.5) * width, 0.0 * cell_x, 0.0 * cell_y)]
        for met, angle in ((first, number * width), (second, (number + 1.0) * width)):
            for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
                part = lambda a, i=i, j=j: a[i : i + nx, j : j + ny]
                traced.append((part(met), angle, part(corner_x) - cell_x, part(corner_y) - cell_y))
        return _entries(traced)

    table = jax.lax.map(entries, (numbers, from_corners, jnp.roll(from_corners, -1, axis=0), from_cells))
    m_x, m_y, start = (jnp.moveaxis(a, 0, -1).reshape(-1) for a in table)
    return m_x, m_y, start


def _entries(traced: list[tuple[Array, Any, Array, Array]]) -> tuple[Array, Array, Array]:
    """Compute one bin's entries from its traced rays: (samples to the hit or 0, angle, offset x, y of the start)."""
    met = jnp.stack([one[0] for one in traced])
    cos, sin = (jnp.stack([f(jnp.asarray(one[1])) for one in traced])[:, None, None] for f in (jnp.cos, jnp.sin))
    x, y = (jnp.stack([one[i] for one in traced]) for i in (2, 3))
    at_x, at_y = x + STEP * met * cos, y + STEP * met * sin
    off_x, off_y = at_x - at_x.mean(0), at_y - at_y.mean(0)
    # The normal is the direction in which the hits vary least.
    phi = 0.5 * jnp.arctan2(2.0 * (off_x * off_y).mean(0), (off_x**2).mean(0) - (off_y**2).mean(0))
    n_x, n_y = -jnp.sin(phi), jnp.cos(phi)
    height = n_x * at_x.mean(0) + n_y * at_y.mean(0)
    height = jnp.where(jnp.abs(height) < 1e-3, 1e-3, height)
    m_x, m_y = n_x / height, n_y / height
    steep = m_x * cos + m_y * sin
    predicted = (1.0 - m_x * x - m_y * y) / jnp.where(steep > 1e-6, steep, 1e-6) / STEP
    error = STEP * jnp.abs(predicted - met)
    across = error * jnp.abs(n_x * cos + n_y * sin)
    holds = jnp.all((met > 0.0) & (across < ACROSS_TOLERANCE) & (error < ALONG_TOLERANCE), axis=0)
    nothing = jnp.all(met == 0.0, axis=0)
    shortest = jnp.min(jnp.where(met > 0.0, met, jnp.inf), axis=0)
    start = jnp.where(jnp.isfinite(shortest), jnp.maximum(shortest - 1.0 / STEP, 0.0), 0.0)
    sure = holds | nothing
    return jnp.where(holds, m_x, 0.0), jnp.where(holds, m_y, 0.0), jnp.where(sure, SURE, start)
