"""Resample images to a cylinder around the camera: columns are azimuths, rows are slopes ``tan(elevation)``.

A robot on a floor knows the height and the mounting of its camera. A turn of its body by one column therefore shifts
its image by one column, and changes nothing else. A direction of the cylinder has a horizontal part of length 1, so
that the *range* along it is the horizontal distance to the surface, m.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.inference.filter import Rig

STEEPEST = 4.0  # slope of a ray: a camera that sees the vertical has no cylinder
DARK = 0.08  # added to colours in [0, 1] before the logarithm: darker ones differ by noise


@dataclass(frozen=True)
class CylinderConfig:
    """Configure the grid of a cylinder."""

    columns: int = 120  # around the robot, of 3 degrees
    rows: int = 16  # within the camera's view
    map_samples: int = 2  # rays along each side of a cell, into the map
    image_samples: int = 4  # pixels along each side of a cell, of an image
    most_missing: float = 0.75  # share of a cell's pixels that may have no reading

    @property
    def step(self) -> float:
        """Return the angle of a column, rad."""
        return 2.0 * math.pi / self.columns


class Ring(NamedTuple):
    """Hold what a cylinder shows, whole or in part.

    Attributes:
        log_range: logarithm of the horizontal distance, m; 0 without a reading.
        log_colour: logarithm of ``colour + DARK`` by channel.
        read: 1 where there is a distance, else 0.
        seen: 1 where there is a colour, else 0.
    """

    log_range: Float[np.ndarray, "rows *places columns"]
    log_colour: Float[np.ndarray, "3 rows *places columns"]
    read: Float[np.ndarray, "rows *places columns"]
    seen: Float[np.ndarray, "rows *places columns"]


@dataclass(frozen=True)
class Cylinder:
    """Describe the cells of a cylinder that a camera can see, in the body's frame.

    Attributes:
        config: of the grid.
        rig: the camera and its pose on the body.
        slopes: ``(rows + 1,)`` tan(elevation) of the rows' edges, from the top down.
        first: leftmost column of the view relative to the column of the body's heading; columns count to the left.
        columns: of the view.
    """

    config: CylinderConfig
    rig: Rig
    slopes: np.ndarray
    first: int
    columns: int

    @classmethod
    def of(cls, rig: Rig, config: CylinderConfig = CylinderConfig()) -> "Cylinder":
        """Return the cylinder of a camera on a robot.

        Raises:
            InputError: a camera that looks up or down so far that its view has no slopes.
        """
        camera, R = rig.camera, np.asarray(rig.T_body_cam, np.float64)[:3, :3]
        u, v = np.meshgrid(np.linspace(-0.5, camera.width - 0.5, 33), np.linspace(-0.5, camera.height - 0.5, 25))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)]).reshape(3, -1)
        x, y, z = R @ rays
        slope, azimuth = z / np.maximum(np.hypot(x, y), 1e-6), np.arctan2(y, x)
        if np.abs(slope).max() > STEEPEST:
            raise InputError("Cylinder", "rig", f"a camera that looks about level: no slope beyond {STEEPEST:g}")
        first, last = (int(np.round(a / config.step)) for a in (azimuth.min(), azimuth.max()))
        edges = np.linspace(slope.max(), slope.min(), config.rows + 1)
        return cls(config, rig, edges, first, min(last - first + 1, config.columns))

    def directions(self, first: int, columns: int, samples: int) -> Float[np.ndarray, "rows columns 3"]:
        """Return directions in the body's frame, ``samples`` along each side of a cell, horizontal part of length 1.

        Args:
            first: column to begin at, relative to the body's heading.
            columns: number of columns.
            samples: along each side of a cell.
        """
        part = (np.arange(samples) + 0.5) / samples
        azimuths = (first + np.arange(columns)[:, None] + part - 0.5).reshape(-1) * self.config.step
        slopes = (self.slopes[:-1, None] + np.diff(self.slopes)[:, None] * part).reshape(-1)
        a, t = np.meshgrid(azimuths, slopes)
        return np.stack([np.cos(a), np.sin(a), t], axis=-1)

    def resample(self, rgb: np.ndarray, depth: np.ndarray | None) -> Ring:
        """Return what an image shows: mean colours, and medians of the distances.

        Args:
            rgb: ``(height, width, 3)`` in [0, 1].
            depth: ``(height, width)`` z-depth, m, 0 without a reading; None for an image of colours alone.
        """
        c, camera, n = self.config, self.rig.camera, self.config.image_samples
        rays = self.directions(self.first, self.columns, n) @ np.asarray(self.rig.T_body_cam, np.float64)[:3, :3]
        ahead = rays[..., 2] > 1e-3
        z = np.where(ahead, rays[..., 2], 1.0)
        u = np.rint(rays[..., 0] / z * camera.fx + camera.cx).astype(int)
        v = np.rint(rays[..., 1] / z * camera.fy + camera.cy).astype(int)
        inside = ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        u, v = np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1)
        cells = lambda a: self._by_cell(a, n)
        inside_cell, colour = cells(inside), cells(rgb[v, u])
        count = np.maximum(inside_cell.sum(-1), 1)
        seen = inside_cell.mean(-1) >= 0.5
        mean = (colour * inside_cell[..., None]).sum(-2) / count[..., None]
        log_range, read = np.zeros(seen.shape), np.zeros(seen.shape, bool)
        if depth is not None:
            distance = cells(depth[v, u] / z)
            valid = inside_cell & np.isfinite(distance) & (distance > 0.0)
            read = seen & (valid.mean(-1) >= 1.0 - c.most_missing)
            log_range = _log_median(distance, valid)
        return Ring(
            log_range.astype(np.float32),
            np.moveaxis(np.log(mean + DARK), -1, 0).astype(np.float32),
            read.astype(np.float32),
            seen.astype(np.float32),
        )

    def _by_cell(self, values: np.ndarray, n: int) -> np.ndarray:
        """Return ``(rows, columns, n * n, ...)`` of values on the grid of samples."""
        rows, columns = self.config.rows, values.shape[1] // n
        split = values.reshape(rows, n, columns, n, *values.shape[2:]).swapaxes(1, 2)
        return split.reshape(rows, columns, n * n, *values.shape[2:])


def _log_median(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the logarithm of the lower median of the valid values; 0 where there is none."""
    count = valid.sum(-1)
    ordered = np.sort(np.where(valid, values, np.inf), axis=-1)
    median = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.log(np.where(count > 0, median, 1.0))
