"""Hold posed images, and measure how well a map predicts held-out ones: ``log p(x | z, M)`` a pixel."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.inference.mapping.scale_fit import PixelPairs, fit
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, has_reading, log_prob

FITTED_VIEWS = 20  # whose pixels give the scales, spread over all views


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
    """Hold errors of pixels with a reading and an observed surface of the map, and the likelihood of all pixels."""

    depth_l1: float  # m; NaN where there is no such pixel
    depth_median: float  # m
    colour_l1: float  # a channel, [0, 1]
    log_likelihood: float  # nats a pixel, over all pixels, with a reading or without
    hit_share: float  # of the pixels with a reading


def pairs_of(m: VoxelMap, views: Views, max_depth: float = MAX_DEPTH) -> list[PixelPairs]:
    """Return the pixels of each view beside what the map predicts from its pose."""
    pairs = []
    for i in range(len(views)):
        predicted = emission.render(m, views.T_world_cam[i], views.camera, max_depth)
        read = views.depth[i] > 0.0
        image = RGBD(views.depth[i], views.rgb[i].astype(jnp.float32) / 255.0, read, read)
        pairs.append(PixelPairs.of(image, predicted))
    return pairs


def held_out(m: VoxelMap, views: Views, scales: EmissionScales, max_depth: float = MAX_DEPTH) -> HeldOut:
    """Evaluate ``log p(x | z, M)`` a pixel and errors on views that were not used to make the map (eq. I42).

    Args:
        m: The map.
        views: Held-out images at known poses.
        scales: Of the emission, for the likelihood.
        max_depth: m; farther readings count as none.
    """
    depths, colours, nats, read = [], [], [], 0
    for pairs in pairs_of(m, views, max_depth):
        d, c, r, log_p = (np.asarray(a) for a in _compared(pairs, scales, max_depth))
        both = r & np.asarray(pairs.predicted.known)
        depths.append(d[both])
        colours.append(c[both])
        nats.append(log_p.mean(dtype=np.float64))
        read += int(r.sum())
    depth, colour = np.concatenate(depths), np.concatenate(colours)
    if len(depth) == 0:
        return HeldOut(np.nan, np.nan, np.nan, float(np.mean(nats)), 0.0)
    return HeldOut(
        float(depth.mean()), float(np.median(depth)), float(colour.mean()), float(np.mean(nats)), len(depth) / read
    )


@jax.jit
def _compared(pairs: PixelPairs, scales: EmissionScales, max_depth: float | Array) -> tuple[Array, Array, Array, Array]:
    """Return depth residuals, mean colour residuals, which pixels have a reading, and their log densities."""
    image, predicted = pairs.image, pairs.predicted
    log_p = log_prob(image, predicted, scales, max_depth).total
    off, off_rgb = jnp.abs(image.depth - predicted.depth), jnp.abs(image.rgb - predicted.rgb).mean(-1)
    return off, off_rgb, has_reading(image, max_depth), log_p


def fit_scales(m: VoxelMap, views: Views, max_depth: float = MAX_DEPTH) -> EmissionScales:
    """Estimate the emission scales of greatest likelihood given the map, from some of the views (eq. I42)."""
    chosen = np.unique(np.linspace(0, len(views) - 1, FITTED_VIEWS).round().astype(int))
    return fit(PixelPairs.drawn(pairs_of(m, views[chosen], max_depth)), max_depth)
