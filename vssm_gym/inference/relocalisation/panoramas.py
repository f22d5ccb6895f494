"""Render panoramas of a map at places on the floor: the index that an image is compared with.

A panorama is the cylinder of :mod:`vssm_gym.inference.relocalisation.cylinder` all around a place, rendered from the
map's mean. Places are rendered in batches of one size, so that nothing is compiled again for another map of the same
grid or for more places. Columns are stored twice in a row: a window at any heading is then a slice.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.inference.relocalisation.cylinder import DARK, Cylinder, Ring
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission

BATCH = 64  # places that are rendered by one call


@dataclass(frozen=True)
class Panoramas:
    """Hold panoramas by place.

    Attributes:
        places: ``(n, 2)`` of the camera in the map's frame, m.
        ring: what is seen from there; arrays ``(rows, n, 2 columns)``.
    """

    places: Float[np.ndarray, "n 2"]
    ring: Ring

    @classmethod
    def of(
        cls,
        m: VoxelMap,
        cylinder: Cylinder,
        places: Float[np.ndarray, "n 2"],
        max_depth: float,
        batch: int = BATCH,
    ) -> "Panoramas":
        """Render the panoramas of a map.

        Args:
            m: the map; its z axis points up, the floor is at 0.
            cylinder: of the camera.
            places: of the camera, m.
            max_depth: range of the rendering, m.
            batch: places that are rendered by one call; it is part of what is compiled.
        """
        c, height = cylinder.config, float(cylinder.rig.T_body_cam[2, 3])
        directions = cylinder.directions(0, c.columns, c.map_samples).reshape(-1, 3)
        centres = np.concatenate([places, np.full((len(places), 1), height)], axis=1)
        parts = []
        for begin in range(0, len(centres), batch):
            some = centres[begin : begin + batch]
            padded = np.concatenate([some, np.repeat(some[:1], batch - len(some), axis=0)])
            seen = _look_around(m, jnp.asarray(padded, jnp.float32), jnp.asarray(directions, jnp.float32), max_depth)
            parts.append([_pooled(np.asarray(a)[: len(some)], c.rows, c.columns) for a in seen])
        distance, rgb, known = (np.concatenate(a) for a in zip(*parts, strict=True))
        return cls(np.asarray(places, np.float64), _ring(distance, rgb, known))


@jax.jit
def _look_around(
    m: VoxelMap, centres: Float[Array, "places 3"], directions: Float[Array, "rays 3"], max_depth: float | Array
) -> tuple[Array, Array, Array]:
    """Return range, colour and whether an observed surface was hit, by place and ray."""

    def one(centre):
        k, hit = emission.search(m, centre, directions, max_depth)
        k = jnp.where(hit, k, 2)
        distance = emission.intersect(m, centre, directions, k)
        surface = centre + directions * distance[:, None]
        return distance, m.colour_at(surface), hit & (m.observed_at(surface) >= emission.KNOWN_SHARE)

    return jax.lax.map(one, centres)


def _pooled(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return ``(places, rows, columns, samples, ...)`` of values by ray."""
    n = round((values.shape[1] / (rows * columns)) ** 0.5)
    split = values.reshape(len(values), rows, n, columns, n, *values.shape[2:]).swapaxes(2, 3)
    return split.reshape(len(values), rows, columns, n * n, *values.shape[2:])


def _ring(distance: np.ndarray, rgb: np.ndarray, known: np.ndarray) -> Ring:
    """Return medians of the distances and means of the colours where at least half of a cell is known."""
    count = known.sum(-1)
    ordered = np.sort(np.where(known, distance, np.inf), axis=-1)
    median = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    seen = 2 * count >= known.shape[-1]
    mean = (rgb * known[..., None]).sum(-2) / np.maximum(count, 1)[..., None]
    twice = lambda a: np.ascontiguousarray(np.concatenate([a, a], axis=-1), np.float32)
    by_row = lambda a: twice(np.moveaxis(a, 0, -2))  # (places, rows, columns) -> (rows, places, columns)
    colour = np.moveaxis(np.log(np.maximum(mean, 0.0) + DARK), -1, 0)
    return Ring(
        by_row(np.log(np.where(seen, np.maximum(median, 1e-2), 1.0))),
        np.stack([by_row(channel) for channel in colour]),
        by_row(seen),
        by_row(seen),
    )
