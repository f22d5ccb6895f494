"""Compute the field, the renderer and the density of an image in plain float64 NumPy, without skipping and JAX."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from tests.helpers.analytic_room import ray_directions
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_MEAN, VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, STEP
from vssm_gym.model.emission_density import EmissionScales


@dataclass
class FieldOracle:
    """Interpolate cells ``values`` (nx, ny, nz, 4) trilinearly: occupancy and RGB."""

    values: np.ndarray
    origin: np.ndarray
    voxel_size: float

    @classmethod
    def of(cls, m: VoxelMap) -> "FieldOracle":
        """Return the same cells as a map."""
        occupancy, colour = np.asarray(m.dense(m.occupancy), float), np.asarray(m.dense(m.colour), float)
        values = np.concatenate([occupancy[..., None], colour], axis=-1)
        return cls(values, np.asarray(m.origin, float), float(m.voxel_size))

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Return ``f_M(p)`` (..., 4) at world points (..., 3)."""
        g = (p - self.origin) / self.voxel_size
        top = np.array(self.values.shape[:3]) - 1
        low = np.clip(np.floor(g), 0, top - 1).astype(int)
        fraction = g - low
        value = np.zeros((*p.shape[:-1], 4))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, fraction, 1.0 - fraction), axis=-1)
            i, j, k = np.moveaxis(low + corner, -1, 0)
            value += weight[..., None] * self.values[i, j, k]
        inside = np.all((g >= 0.0) & (g <= top), axis=-1)
        return np.where(inside[..., None], value, [PRIOR_OCCUPANCY_MEAN, 0.0, 0.0, 0.0])

    def first_hit(self, centre: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the first sample above 0 (rays,), whether there is one, and all occupancies (rays, samples)."""
        e = STEP * self.voxel_size
        d = e * np.arange(1, int(MAX_DEPTH / e) + 1)
        o = self(centre + directions[:, None] * d[:, None])[..., 0]
        above = o > 0.0
        above[:, 0] = False  # the first sample never counts as a hit
        return above.argmax(axis=1) + 1, above.any(axis=1), o

    def render(self, T_world_cam: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return depth (rays,), colour (rays, 3) and first sample k (rays,), 0 where nothing is hit."""
        e = STEP * self.voxel_size
        centre, directions = T_world_cam[:3, 3], ray_directions(T_world_cam, camera)
        k, hit, o = self.first_hit(centre, directions)
        ray = np.arange(len(k))
        o_k, o_before = o[ray, k - 1], np.where(k > 2, o[ray, k - 2], np.minimum(o[ray, k - 2], 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            a = -o_before / (o_k - o_before)
            depth = a * k * e + (1.0 - a) * (k - 1) * e
        depth = np.where(hit, depth, 0.0)
        rgb = self(centre + directions * depth[:, None])[:, 1:]
        return depth, np.where(hit[:, None], rgb, 0.0), np.where(hit, k, 0)


KNOWN, GUESSED, EMPTY = range(3)  # what the map predicts at a pixel: an observed surface, another one, none


def shares(kind: np.ndarray, scales: EmissionScales) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the probability of no reading, and the shares of outliers of depth and colour, by kind of pixel."""
    misses = np.array([scales.miss, scales.guess_miss, scales.empty_miss], float)
    outliers = np.array([scales.outlier, scales.guess_outlier, 1.0], float)
    rgb_outliers = np.array([scales.rgb_outlier, scales.guess_rgb_outlier, 1.0], float)
    return misses[kind], outliers[kind], rgb_outliers[kind]


def truncated(x: np.ndarray, location: np.ndarray, scale: np.ndarray | float, end: float) -> np.ndarray:
    """Return the Laplace density renormalised on ``[0, end]``."""
    mass = stats.laplace.cdf(end, location, scale) - stats.laplace.cdf(0.0, location, scale)
    return stats.laplace.pdf(x, location, scale) / mass


def pixel_log_prob(
    depth: np.ndarray,
    rgb: np.ndarray,
    predicted_depth: np.ndarray,
    predicted_rgb: np.ndarray,
    kind: np.ndarray,
    scales: EmissionScales,
    max_depth: float = MAX_DEPTH,
    depth_std: float = 0.0,
    rgb_std: float = 0.0,
) -> np.ndarray:
    """Return the log density of each pixel ``(n,)``; a depth of 0 is no reading."""
    miss, outlier, rgb_outlier = shares(np.asarray(kind), scales)
    std = np.where(np.asarray(kind) == KNOWN, 1.0, 0.0)
    scale = np.hypot(float(scales.depth) + float(scales.growth) * predicted_depth**2, std * depth_std / np.sqrt(2.0))
    stds = [np.hypot(float(own), std[:, None] * rgb_std) for own in (scales.rgb, scales.textured_rgb)]
    ends = [[(end - predicted_rgb) / s for end in (0.0, 1.0)] for s in stds]
    plain, rough = (stats.truncnorm.pdf(rgb, *e, predicted_rgb, s).prod(-1) for e, s in zip(ends, stds, strict=True))
    other = stats.fisk(3.0, scale=float(scales.outlier_depth))
    any_depth = other.pdf(depth) / other.cdf(max_depth)
    of_depth = (1 - outlier) * truncated(depth, predicted_depth, scale, max_depth) + outlier * any_depth
    textured = float(scales.textured)
    of_rgb = (1 - rgb_outlier) * ((1 - textured) * plain + textured * rough) + rgb_outlier
    with np.errstate(divide="ignore"):
        return np.where(depth > 0.0, np.log((1 - miss) * of_depth * of_rgb), np.log(miss))
