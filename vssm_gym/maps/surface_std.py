"""``var = s^2 / n + (a h)^2 + h^2 (b k)^2 / (1 + (b k / c)^2) + var_poses``: of the place of a map's surface.

The error is that of the surface's place along its normal, m. Its parts, in this order:

- *readings*: ``s`` is the std of one reading and ``n`` the number of readings, which the map's precision counts. Their
  errors are independent and average out;
- *cells*: a part of the edge ``h`` of a cell that no number of readings removes;
- *curvature*: a cell's value is a projected, truncated distance, and the field between cells is trilinear. Where the
  surface bends within a few cells the zero level is off by a part of a cell. ``k`` is the bend of the field there: the
  second differences of occupancy over a cell along the three axes,
  ``k^2 = sum_i (o(p + h e_i) - 2 o(p) + o(p - h e_i))^2 / h^2``. It is 0 on a plane and about 1 at a box's edge. The
  part is ``c h`` at most;
- *poses*: the errors of the poses at which images entered the map, which are common to all of an image's readings
  (:mod:`vssm_gym.maps.pose_errors`); 0 for a map that was learned at true poses.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap

# Fitted by maximum likelihood on maps of fern, ivy, moss and reed in cells of 5, 7 and 10 cm, from exact and from
# Kinect depth: ``vssm-gym study map-reliability`` repeats the measurement.
READING_STD = 0.006  # s, m
CELL_SHARE = 0.02  # a
BEND_SHARE = 0.41  # b
LARGEST_BEND = 0.38  # c
MIN_GRADIENT = 0.1  # of occupancy; where the field is flatter it has no direction


_STENCIL = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])  # cells around a point


def differences(m: VoxelMap, p_world: Float[Array, "*batch 3"]) -> tuple[Array, Array, Array]:
    """Return occupancy (m), its gradient, and its second differences over a cell (m) along the axes, at points (m)."""
    h = m.voxel_size
    o = m.occupancy_at(p_world[..., None, :] + h * _STENCIL)  # one query: each more would be compiled anew
    after, before = o[..., 1:4], o[..., 4:]
    return o[..., 0], (after - before) / (2.0 * h), after - 2.0 * o[..., :1] + before


@jax.jit
def surface_std(
    m: VoxelMap,
    p_world: Float[Array, "*batch 3"],
    reading_std: Float[Array, ""] | float = READING_STD,
    pose_errors: PoseErrors | None = None,
) -> Float[Array, "*batch"]:
    """Return the std of the surface's place along its normal, m (eq. M12).

    Args:
        m: the map.
        p_world: points on its surface, m.
        reading_std: s, of one reading that the map's precision counts by 1, m.
        pose_errors: of the poses at which the images entered the map; None: they were true.

    Returns:
        The std; infinite at points around which nothing was observed.
    """
    _, gradient, second = differences(m, p_world)
    precision, h = m.precision(p_world)[..., 0], m.voxel_size
    bend = BEND_SHARE**2 * jnp.sum(second**2, axis=-1)  # (b k h)^2
    variance = reading_std**2 / precision + (CELL_SHARE * h) ** 2
    variance += bend / (1.0 + bend / (LARGEST_BEND * h) ** 2)
    if pose_errors is not None:
        normal = gradient / jnp.maximum(jnp.linalg.norm(gradient, axis=-1, keepdims=True), MIN_GRADIENT)
        variance += pose_errors.variance(p_world, normal)
    return jnp.where(precision > OBSERVED_PRECISION, jnp.sqrt(variance), jnp.inf)
