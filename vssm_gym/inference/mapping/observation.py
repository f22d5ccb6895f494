"""``occupancy ~ N(-sdf, std^2)``, ``colour ~ N(rgb, std^2)``: observe cells by a posed image (PRISM, step 5).

``sdf = clip(d_obs(pi(p)) - z_cam(p), -trunc, trunc)`` for cells between the camera and a truncation band behind the
surface. Colour is observed only within the band: free space has no colour, and a cell just before the surface must not
get the colour of the wall behind. With samples of the pose the observation is taken in expectation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.maps.voxel_map import OBSERVATION_COLOUR_STD, OBSERVATION_STD, TRUNCATION


@dataclass(frozen=True)
class MapUpdateConfig:
    """Configure the map update."""

    truncation: float = TRUNCATION  # voxels behind the surface; 4 for noisy stereo depth (PRISM)
    std: float = 1.0  # of the observation of occupancy (m) and of colour
    min_depth: float = 0.05  # m
    max_depth: float = MAX_DEPTH  # m; farther readings are left out


class Observation(NamedTuple):
    """Hold a Gaussian observation of cells."""

    weight: Array  # (blocks, cells) precision of occupancy
    occupancy: Array  # (blocks, cells) m
    colour_weight: Array  # (blocks, cells) precision of each colour channel
    colour: Array  # (blocks, 3, cells)


class Pixels(NamedTuple):
    """Hold an image as a list of pixels.

    An additional last pixel without a reading represents points outside of the image.
    """

    depth: Float[Array, "pixels"]  # m, 0 = no reading
    rgb: Float[Array, "values"]  # [0, 1], three a pixel

    @classmethod
    def of(cls, depth: Float[Array, "height width"], rgb: Float[Array, "height width 3"], max_depth: float) -> "Pixels":
        """Flatten an image; invalid readings and those beyond ``max_depth`` (m) become 0."""
        depth = jnp.where(jnp.isfinite(depth) & (depth <= max_depth), depth, 0.0)
        return cls(jnp.append(depth, 0.0), jnp.append(rgb, jnp.zeros(3)))


def observe_cells(
    p_cam: tuple[Array, Array, Array], voxel_size: Array, pixels: Pixels, camera: Camera, config: MapUpdateConfig
) -> Observation:
    """Return the Gaussian observation of cells at camera-frame ``x, y, z``, each ``(blocks, cells)`` (eq. I19)."""
    x, y, z = p_cam
    ahead = z > config.min_depth
    inverse_z = 1.0 / jnp.where(ahead, z, 1.0)
    u = jnp.round(x * inverse_z * camera.fx + camera.cx).astype(jnp.int32)
    v = jnp.round(y * inverse_z * camera.fy + camera.cy).astype(jnp.int32)
    inside = ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    # All results below depend on z and this look-up only: otherwise the compiler would repeat the projection for each.
    pixel = jnp.where(inside, v * camera.width + u, camera.height * camera.width)
    d = pixels.depth.at[pixel].get(mode="promise_in_bounds")
    sdf = d - z
    truncation = config.truncation * voxel_size
    seen = (d > config.min_depth) & (sdf > -truncation)
    weight = config.std**-2
    channel = (3 * pixel)[:, None, :] + np.arange(3)[:, None]  # one look-up of three channels vectorises, three do not
    colour = pixels.rgb.at[channel].get(mode="promise_in_bounds")
    occupancy = -jnp.clip(sdf, -truncation, truncation)
    return Observation(weight * seen, occupancy, weight * (seen & (sdf < truncation)), colour)


def expectation(observe: Callable[[Array], Observation], T_cam_world: Float[Array, "samples 4 4"]) -> Observation:
    """``E_q(z) [o]`` over pose samples, by moment matching: disagreement between samples lowers the precision.

    Mean ``sum_s w_s o_s / sum_s w_s``; precision ``mean_s(w_s) / (1 + Var_s(o_s) / sigma^2)``, where sigma is the std
    of one real observation (the update's own std only counts observations). With one sample, its observation is
    returned.
    """
    samples = T_cam_world.shape[0]
    if samples == 1:
        return observe(T_cam_world[0])

    def moments(T):
        o = observe(T)
        w, w_c = o.weight, o.colour_weight[:, None, :]
        first = (o.weight, w * o.occupancy, o.colour_weight, w_c * o.colour)
        return first, (w * o.occupancy**2, jnp.sum(w_c * o.colour**2, axis=1))

    def add(i, total):
        return jax.tree.map(jnp.add, total, moments(T_cam_world[i]))

    (w, wo, w_c, wc), (woo, wcc) = jax.lax.fori_loop(1, samples, add, moments(T_cam_world[0]))
    safe, safe_c = jnp.where(w > 0.0, w, 1.0), jnp.where(w_c > 0.0, w_c, 1.0)
    mean, colour = wo / safe, wc / safe_c[:, None, :]
    variance = jnp.maximum(woo / safe - mean**2, 0.0)
    variance_c = jnp.maximum(wcc / safe_c - jnp.sum(colour**2, axis=1), 0.0) / 3.0  # of a channel, on average
    return Observation(
        w / samples / (1.0 + variance / OBSERVATION_STD**2),
        mean,
        w_c / samples / (1.0 + variance_c / OBSERVATION_COLOUR_STD**2),
        colour,
    )
