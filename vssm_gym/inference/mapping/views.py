"""Hold posed images, and measure how well a map predicts held-out ones: ``log p(x | z, M)`` a pixel."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import EmissionScales

FITTED_VIEWS = 20  # whose residuals give the scales, spread over all views
SMALLEST_SCALE = 1e-3  # m and colour: lower bound for maps that predict some pixels exactly


class Views(eqx.Module):
    """Hold posed RGB-D images of one camera."""

    depth: Float[Array, "views height width"]  # z-depth, m; 0 = no reading
    rgb: UInt8[Array, "views height width 3"]
    T_world_cam: Float[Array, "views 4 4"]
    camera: Camera

    @classmethod
    def stack(
        cls, images: Sequence[tuple[np.ndarray, np.ndarray]], poses: Float[np.ndarray, "views 4 4"], camera: Camera
    ) -> "Views":
        """Stack ``(rgb uint8, depth m)`` pairs of a frame reader; readings that are not finite become 0."""
        depth = np.stack([np.where(np.isfinite(depth), depth, 0.0) for _, depth in images])
        rgb = np.stack([rgb for rgb, _ in images])
        return cls(
            jnp.asarray(depth, jnp.float32), jnp.asarray(rgb, jnp.uint8), jnp.asarray(poses, jnp.float32), camera
        )

    def __len__(self) -> int:
        return self.depth.shape[0]

    def __getitem__(self, chosen: np.ndarray | slice) -> "Views":
        """Select views."""
        return Views(self.depth[chosen], self.rgb[chosen], self.T_world_cam[chosen], self.camera)


class HeldOut(NamedTuple):
    """Hold means over the pixels with a reading at which the map has an observed surface, and their share."""

    depth_l1: float  # m
    depth_median: float  # m
    colour_l1: float  # a channel, [0, 1]
    log_likelihood: float  # nats a pixel (depth and three channels), Laplace
    hit_share: float  # of the pixels with a reading


@jax.jit
def _residuals(image: emission.RGBD, depth: Array, rgb: Array, max_depth: float | Array) -> tuple[Array, Array, Array]:
    """Return depth residuals (-1 where there is none), mean colour residuals, and which pixels have a reading."""
    read = (depth > 0.0) & (depth <= max_depth)
    both = read & image.known
    return jnp.where(both, jnp.abs(image.depth - depth), -1.0), jnp.abs(image.rgb - rgb / 255.0).mean(-1), read


def _all_residuals(m: VoxelMap, views: Views, max_depth: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return absolute depth and mean colour residuals of all pixels with reading and surface.

    And the number of readings.
    """
    depths, colours, read = [], [], 0
    for i in range(len(views)):
        image = emission.render(m, views.T_world_cam[i], views.camera, max_depth)
        d, c, r = _residuals(image, views.depth[i], views.rgb[i], max_depth)
        hit = np.asarray(d) >= 0.0
        depths.append(np.asarray(d)[hit])
        colours.append(np.asarray(c)[hit])
        read += int(r.sum())
    return np.concatenate(depths), np.concatenate(colours), read


def held_out(m: VoxelMap, views: Views, scales: EmissionScales, max_depth: float = MAX_DEPTH) -> HeldOut:
    """Evaluate ``log p(x | z, M)`` a pixel and errors on views that were not used to make the map (eq. I42).

    Args:
        m: The map.
        views: Held-out images at known poses.
        scales: Of the emission, for the likelihood.
        max_depth: m; farther readings are left out.
    """
    depth, colour, read = _all_residuals(m, views, max_depth)
    s_depth, s_rgb = float(scales.depth), float(scales.rgb)
    if len(depth) == 0:
        return HeldOut(np.nan, np.nan, np.nan, np.nan, 0.0)
    nats = -depth / s_depth - 3.0 * colour / s_rgb - np.log(2.0 * s_depth) - 3.0 * np.log(2.0 * s_rgb)
    return HeldOut(
        float(depth.mean()),
        float(np.median(depth)),
        float(colour.mean()),
        float(nats.mean()),
        len(depth) / max(read, 1),
    )


def fit_scales(m: VoxelMap, views: Views, max_depth: float = MAX_DEPTH) -> EmissionScales:
    """Estimate the scales of greatest likelihood given the map, ``s = mean |r|``, from some of the views."""
    chosen = np.unique(np.linspace(0, len(views) - 1, FITTED_VIEWS).round().astype(int))
    depth, colour, _ = _all_residuals(m, views[chosen], max_depth)
    if len(depth) == 0:
        return EmissionScales()
    return EmissionScales(*(jnp.float32(max(float(r.mean()), SMALLEST_SCALE)) for r in (depth, colour)))
