"""Propagate map uncertainty to images: ``p(x | z) = int p(x | z, M) q(M) dM``, to first order or by samples.

The published update gives each observation the std 1; the error of a real reading is a few centimetres. The variance of
a cell is therefore ``s^2 / n``, with ``s`` the std of one reading and ``n`` the precision in units of observations. Two
kinds of cell keep their mean: unobserved cells (independent draws from the broad prior would fill unknown space with
surfaces), and cells two voxels (the default truncation) or more from the surface, whose observations were clipped and
are only bounds.

Cells are independent in ``q(M)`` although the error of one ray is common to them. Averaging over a pixel's eight cells
therefore understates the std of depth by a factor of up to ``sqrt(8)``.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.block_table import cell_offset
from vssm_gym.maps.voxel_map import OBSERVATION_COLOUR_STD, OBSERVATION_STD, OBSERVED_PRECISION, TRUNCATION, VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, RGBD, STEP, render, world_rays

MIN_SLOPE = 0.1  # of occupancy over depth, so that a ray that grazes a surface magnifies errors tenfold at most

# Two samples 0.4 voxels apart lie in one cube or in adjacent ones: cells 0, 1, 2 from the lower one along each axis
_CELLS = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3)


class MeasurementNoise(eqx.Module):
    """Hold the measurement noise of map cells. Precisions in the map count observations of std ``counted``."""

    depth: Float[Array, ""] | float = OBSERVATION_STD  # m
    rgb: Float[Array, ""] | float = OBSERVATION_COLOUR_STD
    counted: Float[Array, ""] | float = 1.0  # MapUpdateConfig.std

    def occupancy_variance(self, mean: Array, precision: Array, voxel_size: Array) -> Array:
        """Return the variance of cells' occupancy, m^2, any shape; 0 where the cell keeps its mean (eq. M12)."""
        measured = (precision > OBSERVED_PRECISION) & (jnp.abs(mean) < TRUNCATION * voxel_size * (1.0 - 1e-4))
        return jnp.where(measured, self.depth**2 / (precision * self.counted**2), 0.0)

    def colour_variance(self, precision: Array) -> Array:
        """Return the variance of cells' colour channels, any shape; 0 where the cell keeps its mean (eq. M12)."""
        return jnp.where(precision > OBSERVED_PRECISION, self.rgb**2 / (precision * self.counted**2), 0.0)


MEASUREMENT_NOISE = MeasurementNoise()


@jax.jit
def image_std(
    m: VoxelMap,
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    image: RGBD,
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE,
) -> tuple[Float[Array, "height width"], Float[Array, "height width 3"]]:
    """Return the std of a rendered image under ``q(M)``, to first order at the hit (eq. M13).

    With ``d* = d_k-1 + a e``, ``a = -o_k-1 / (o_k - o_k-1)`` as rendered and ``g = (o_k - o_k-1) / e``,
    ``var d = var(a o_k + (1 - a) o_k-1) / g^2`` and ``var c = var(colour(p)) + (dc/dd)^2 var d``: sums over cells of
    squared interpolation weights times the cells' variances. ``g`` is taken as at least ``MIN_SLOPE``.

    Args:
        m: The map belief.
        T_world_cam: Camera pose.
        camera: Intrinsics and image size.
        image: What :func:`vssm_gym.model.emission.render` gives for them.
        measurement_noise: Std of one observation.

    Returns:
        Depth std (m) and colour std; infinite where the image is not ``known``.
    """
    centre, directions = world_rays(T_world_cam, camera)
    depth = image.depth.reshape(-1)
    at = lambda d: jnp.stack([centre[a] + directions[:, a] * d for a in range(3)], axis=-1)
    e = STEP * m.voxel_size
    k = jnp.maximum(jnp.ceil(depth / e), 1.0)
    a = depth / e - (k - 1.0)
    slope = jnp.maximum((m.occupancy_at(at(k * e)) - m.occupancy_at(at((k - 1.0) * e))) / e, MIN_SLOPE)
    _, colour_slope = jax.jvp(lambda d: m.colour_at(at(d)), (depth,), (jnp.ones_like(depth),))

    before, after, hit = (m.to_grid(at(d)) for d in ((k - 1.0) * e, k * e, depth))
    low = jnp.floor(jnp.minimum(before, after)).astype(jnp.int32)
    occupancy, occupancy_precision = m.occupancy.reshape(-1), m.occupancy_precision.reshape(-1)
    colour_precision = m.colour_precision.reshape(-1)
    occupancy_variance, colour_variance = jnp.zeros_like(depth), jnp.zeros_like(depth)
    for step in _CELLS:
        cell = [jnp.clip(low[:, axis] + step[axis], 0, n - 1) for axis, n in enumerate(m.shape)]
        offset = cell_offset(cell, m.blocks, m.table)
        read = lambda array: array.at[offset].get(mode="promise_in_bounds")
        weight = a * _hat(after, cell) + (1.0 - a) * _hat(before, cell)
        variance = measurement_noise.occupancy_variance(read(occupancy), read(occupancy_precision), m.voxel_size)
        occupancy_variance += weight**2 * variance
        colour_variance += _hat(hit, cell) ** 2 * measurement_noise.colour_variance(read(colour_precision))
    depth_variance = occupancy_variance / slope**2
    rgb_variance = colour_variance[:, None] + colour_slope**2 * depth_variance[:, None]
    shape = (camera.height, camera.width)
    depth_std = jnp.where(image.known, jnp.sqrt(depth_variance).reshape(shape), jnp.inf)
    rgb_std = jnp.where(image.known[..., None], jnp.sqrt(rgb_variance).reshape(*shape, 3), jnp.inf)
    return depth_std, rgb_std


def _hat(g: Array, cell: list[Array]) -> Array:
    """Return a cell's trilinear weight at cell coordinates ``g`` (rays, 3); 0 for cells of other cubes."""
    x, y, z = (jnp.maximum(1.0 - jnp.abs(g[:, axis] - c), 0.0) for axis, c in enumerate(cell))
    return x * y * z


@jax.jit
def sample_map(key: PRNGKeyArray, m: VoxelMap, measurement_noise: MeasurementNoise = MEASUREMENT_NOISE) -> VoxelMap:
    """Draw ``M ~ q(M)``: a map whose means are drawn cell by cell; precisions stay those of the belief (eq. M14).

    The empty-space index is rebuilt, which costs more than the sampling.
    """
    by_occupancy, by_colour = jax.random.split(key)
    std = jnp.sqrt(measurement_noise.occupancy_variance(m.occupancy, m.occupancy_precision, m.voxel_size))
    colour_std = jnp.sqrt(measurement_noise.colour_variance(m.colour_precision))[:, None]
    occupancy = m.occupancy + std * jax.random.normal(by_occupancy, m.occupancy.shape)
    colour = m.colour + colour_std * jax.random.normal(by_colour, m.colour.shape)
    return eqx.tree_at(lambda m: m.colour, m.with_occupancy(occupancy), colour)


@partial(jax.jit, static_argnames="samples")
def sample_images(
    key: PRNGKeyArray,
    m: VoxelMap,
    T_world_cam: Float[Array, "4 4"],
    camera: Camera,
    samples: int,
    max_depth: float | Array = MAX_DEPTH,
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE,
) -> RGBD:
    """Render ``mu_rgbd(z, M_k)``, ``M_k ~ q(M)``: the same view of ``samples`` maps, one after the other (eq. M14).

    Returns:
        An image whose arrays have ``samples`` as first axis.
    """
    views = lambda k: render(sample_map(k, m, measurement_noise), T_world_cam, camera, max_depth)
    return jax.lax.map(views, jax.random.split(key, samples))
