"""``M_k(p) = mu(p - u_k(p))``: draw maps in which walls move as a whole (VSSM-LM: ``M ~ q(M)``).

A sample is the mean map displaced by a smooth random field,

    u(p) = std(p) g(p) + u_poses(p),

where ``std`` is :func:`~vssm_gym.maps.surface_std.surface_std` without the poses' part, ``g`` three independent
standard Gaussian processes and ``u_poses`` the displacement by the drawn errors of the keyframes
(:mod:`~vssm_gym.maps.pose_errors`). A surface moves along its normal by ``n . u``, whose std is the stated one. Faces
of one wall move together, colours move with their surface, and what was not observed stays so.

``g`` is a sum of ``sqrt(1 / 2F) (a cos(omega . p) + b sin(omega . p))``, ``a, b ~ N(0, 1)`` (Rahimi and Recht, 2007):
its variance is exactly 1 at every point, and its correlation falls with the distance as the mean of two squared
exponentials. Given its coefficients, independent and standard normal, a sample is a function of the map.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.special import ndtri
from scipy.stats.qmc import Halton

from vssm_gym.maps.block_table import BLOCK, PRIOR_SLOT, block_coordinates, cell_offset, rows
from vssm_gym.maps.compaction import set_numbers
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.surface_std import MIN_GRADIENT, READING_STD, differences, surface_std
from vssm_gym.maps.voxel_map import (
    OBSERVATION_COLOUR_STD,
    OBSERVED_PRECISION,
    PRIOR_OCCUPANCY_MEAN,
    PRIOR_OCCUPANCY_STD,
    TRUNCATION,
    VoxelMap,
)

# Fitted to the correlation of measured errors along walls: half of it is lost within a few cells, half within a metre.
NEAR_LENGTH = 2.0  # cells: the shortest that a grid represents; measured lengths are somewhat shorter
FAR_LENGTH = 0.5  # m
FREQUENCIES = 64  # F, of each of the two
BLOCKS_A_TURN = 16  # blocks a loop iteration
FIELDS = 6  # three coordinates of the displacement, three channels of colour

DIRECTIONS = ndtri(Halton(3, scramble=False).random(FREQUENCIES + 1)[1:])  # of N(0, 1) each, evenly spread
_INNER = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)  # cells of a block
_CORNERS = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), -1).reshape(-1, 3)


class MeasurementNoise(eqx.Module):
    """Hold the measurement noise of map cells. Precisions in the map count observations of std ``counted``."""

    depth: Float[Array, ""] | float = READING_STD  # m
    rgb: Float[Array, ""] | float = OBSERVATION_COLOUR_STD
    counted: Float[Array, ""] | float = 1.0  # MapUpdateConfig.std

    @property
    def reading_std(self) -> Float[Array, ""] | float:
        """Return the std of a reading that the map's precision counts by 1, m: as :func:`surface_std` takes it."""
        return self.depth / self.counted

    def colour_std(self, precision: Array) -> Array:
        """Return the std of colour channels, any shape; 0 where none was observed (eq. M12)."""
        return jnp.where(precision > OBSERVED_PRECISION, self.rgb / self.counted / jnp.sqrt(precision), 0.0)


MEASUREMENT_NOISE = MeasurementNoise()


class Coefficients(NamedTuple):
    """Hold the standard normal coefficients that one sample of the map is made of."""

    fields: Float[Array, "fields waves"]  # of cosines and sines, for both lengths
    poses: Float[Array, "keyframes 6"]  # of the keyframes' errors; none where poses were true


def draw_coefficients(key: PRNGKeyArray, pose_errors: PoseErrors | None = None) -> Coefficients:
    """Draw the coefficients of one sample."""
    by_field, by_pose = jax.random.split(key)
    poses = jnp.zeros((0, 6)) if pose_errors is None else pose_errors.draw(by_pose)
    return Coefficients(jax.random.normal(by_field, (FIELDS, 4 * FREQUENCIES)), poses)


def correlation(distance: Float[Array, "*batch"], voxel_size: float | Array) -> Float[Array, "*batch"]:
    """``1/2 exp(-r^2 / 2 (2 h)^2) + 1/2 exp(-r^2 / 2 (0.5 m)^2)``: of ``g`` between points (eq. M14)."""
    near, far = (jnp.exp(-0.5 * (distance / length) ** 2) for length in (NEAR_LENGTH * voxel_size, FAR_LENGTH))
    return 0.5 * (near + far)


@jax.jit
def deform(
    m: VoxelMap,
    coefficients: Coefficients,
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE,
) -> VoxelMap:
    """``M(p) = mu(p - u(p))``: the sample of the map that belongs to coefficients (eq. M14).

    Cells in blocks that hold a surface or lie next to one that does are computed anew; elsewhere there is nothing to
    move. In a block-sparse map, what moves into a block without storage is cut off. The empty-space index is rebuilt.

    Args:
        m: the belief.
        coefficients: of the displacement; all zero give the mean. Its ``poses`` are of ``m.pose_errors``.
        measurement_noise: std of one observation.

    Returns:
        A map on the grid of ``m``, as of true poses. Precisions move with their cells.
    """
    near = m.empty.rings.reshape(-1) <= 1
    if m.table is not None:
        near &= m.table.slot.reshape(-1) != PRIOR_SLOT
    ids, count = set_numbers(near)
    blocks, slots = near.shape[0], m.occupancy.shape[0]
    h = m.voxel_size
    omega = jnp.concatenate([DIRECTIONS / (NEAR_LENGTH * h), DIRECTIONS / FAR_LENGTH])
    inner = jnp.asarray(_INNER, jnp.float32) * h
    waves = jnp.concatenate([jnp.cos(inner @ omega.T), jnp.sin(inner @ omega.T)], axis=-1)  # (cells, 4 F)
    a, b = jnp.split(coefficients.fields * (0.5 / FREQUENCIES) ** 0.5, 2, axis=-1)
    # A displacement by poses is all but linear in a block: it is interpolated between its corners.
    share = np.abs(1 - _CORNERS[None] - _INNER[:, None] / BLOCK).prod(axis=-1)  # (cells, corners)

    def move(i, carry):
        block = jax.lax.dynamic_slice(ids, (i * BLOCKS_A_TURN,), (BLOCKS_A_TURN,))
        known = jnp.minimum(block, blocks - 1)
        first = m.origin + h * BLOCK * jnp.stack(block_coordinates(known, m.blocks), axis=-1)
        p = first[:, None] + inner  # (blocks, cells, 3)
        phase = first @ omega.T  # a cos(x + y) + b sin(x + y), with x of the block and y of the cell in it
        cos, sin = jnp.cos(phase)[:, None], jnp.sin(phase)[:, None]
        turned = jnp.concatenate([a * cos + b * sin, b * cos - a * sin], axis=-1)
        g = jnp.einsum("bfw,cw->bcf", turned, waves)
        std = surface_std(m, _nearest_surface(m, p), measurement_noise.reading_std)
        u = jnp.where(jnp.isfinite(std), std, 0.0)[..., None] * g[..., :3]
        if m.pose_errors is not None:
            corners = first[:, None] + h * BLOCK * _CORNERS
            u += jnp.einsum("ck,bkx->bcx", share, m.pose_errors.displacement(corners, coefficients.poses))
        q = p - u
        nearest = jnp.round(m.to_grid(q)).astype(jnp.int32)
        source = [jnp.clip(nearest[..., axis], 0, n - 1) for axis, n in enumerate(m.shape)]
        at = cell_offset(source, m.blocks, m.table)
        read = lambda array: array.reshape(-1).at[at].get(mode="promise_in_bounds")
        precision, colour_precision = read(m.occupancy_precision), read(m.colour_precision)
        # The mean between observed and unobserved cells would be a surface where nothing was seen.
        seen = precision != jnp.float32(PRIOR_OCCUPANCY_STD**-2)
        occupancy = jnp.where(seen, m.occupancy_at(q), PRIOR_OCCUPANCY_MEAN)
        colour = m.colour_at(q) + measurement_noise.colour_std(colour_precision)[..., None] * g[..., 3:]
        row = jnp.where(block < blocks, rows(known, m.table), slots)
        new = (occupancy, precision, colour.transpose(0, 2, 1), colour_precision)
        return tuple(old.at[row].set(value, mode="drop") for old, value in zip(carry, new, strict=True))

    belief = (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision)
    moved = jax.lax.fori_loop(0, (count + BLOCKS_A_TURN - 1) // BLOCKS_A_TURN, move, belief)
    parts = lambda m: (m.occupancy_precision, m.colour, m.colour_precision)
    return replace(eqx.tree_at(parts, m.with_occupancy(moved[0]), moved[1:]), pose_errors=None)


def sample_map(
    key: PRNGKeyArray,
    m: VoxelMap,
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE,
) -> VoxelMap:
    """Draw ``M ~ q(M)``: a map that is displaced at random as far as it is uncertain (eq. M14).

    Args:
        key: random key.
        m: the belief.
        measurement_noise: std of one observation.
    """
    return deform(m, draw_coefficients(key, m.pose_errors), measurement_noise)


def _nearest_surface(m: VoxelMap, p_world: Array) -> Array:
    """Return the points of the surface on the normals through cells' centres, no farther than the truncation.

    All cells along a normal move alike then: as far as their surface is uncertain.
    """
    o, gradient, _ = differences(m, p_world)
    slope, reach = jnp.maximum(jnp.linalg.norm(gradient, axis=-1), MIN_GRADIENT), TRUNCATION * m.voxel_size
    return p_world - (jnp.clip(o / slope, -reach, reach) / slope)[..., None] * gradient
