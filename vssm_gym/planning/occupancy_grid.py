"""Read a learned map, of space or the plane, as free, occupied and unknown cells, and write them for ``map_server``.

ROS's conventions hold: the origin is the lower left corner of the lower left cell, image rows run from the highest y
down, white is free, black is occupied, and what lies between the two thresholds is unknown.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.maps.columns import BODY_HEIGHTS, OBSERVED_SHARE, observed_columns
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.maps.voxel_map import VoxelMap

FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # as in nav_msgs/OccupancyGrid
# Grey levels of map_saver and the thresholds that go with them: map_server reads a level v as the probability
# (255 - v) / 255, and 205 is 0.19608, just above 0.196. With nav2's usual 0.25 unknown space would be free.
GREY = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # probabilities of occupancy


@dataclass(frozen=True)
class OccupancyGrid:
    """Hold the state of each cell of the floor plan for a robot of some height.

    Attributes:
        cells: ``(nx, ny)`` int8 of :data:`FREE`, :data:`OCCUPIED`, :data:`UNKNOWN`, indexed ``[ix, iy]`` along world
            x, y.
        origin: ``(2,)`` world position of the corner of cell ``[0, 0]`` with the lowest x and y, m.
        resolution: edge of a cell, m.
    """

    cells: np.ndarray
    origin: np.ndarray
    resolution: float

    @classmethod
    def from_voxel_map(
        cls,
        voxel_map: VoxelMap,
        resolution: float = 0.05,
        height: float = BODY_HEIGHTS[1],
        z_min: float = BODY_HEIGHTS[0],
    ) -> "OccupancyGrid":
        """Find the cells in which a robot as high as ``height`` (m) would collide, by the map's mean field.

        A cell is sampled in columns half a voxel apart. It is occupied where the field exceeds zero in any of them
        between ``z_min`` and ``height``, else unknown where less than half of these heights were ever observed. The
        grid covers what is not unknown.

        Raises:
            InputError: a resolution or height that makes no map, or a map that shows nothing at these heights.
        """
        if not 0.01 <= resolution <= 1.0:
            raise InputError("map", "resolution", f"a cell size from 0.01 to 1 m; found {resolution}")
        if not z_min < height <= 5.0:
            raise InputError("map", "height", f"a robot's height above {z_min} m, up to 5 m; found {height}")
        per_cell = max(1, int(np.ceil(resolution / (0.5 * float(voxel_map.voxel_size)) - 1e-6)))
        spacing = resolution / per_cell
        top, share = observed_columns(voxel_map, z_min, height, spacing)
        occupied = np.asarray(_blocks(top > 0.0, per_cell).any(axis=(1, 3)))
        unknown = _blocks(share, per_cell).mean(axis=(1, 3)) < OBSERVED_SHARE
        if unknown.all() and not occupied.any():
            raise InputError("map", "belief", f"something observed between {z_min} and {height} m; found nothing")
        # The first column stands in the middle of its share of the cell.
        return cls._of_known(occupied, unknown, voxel_map.bounds[0, :2] - 0.5 * spacing, float(resolution))

    @classmethod
    def from_planar_map(cls, planar_map: PlanarMap) -> "OccupancyGrid":
        """Return the cells of a map of the plane: occupied where the mean exceeds zero, unknown where never observed.

        Raises:
            InputError: a map that shows nothing.
        """
        unknown = np.asarray(~planar_map.observed)
        if unknown.all():
            raise InputError("map", "belief", "something observed; found nothing")
        occupied = np.asarray(np.asarray(planar_map.occupancy) > 0.0) & ~unknown
        cell = round(float(planar_map.cell_size), 6)  # 0.1, not the float32 beside it
        return cls._of_known(occupied, unknown, np.asarray(planar_map.origin, np.float64) - 0.5 * cell, cell)

    @classmethod
    def _of_known(cls, occupied: np.ndarray, unknown: np.ndarray, corner: np.ndarray, cell: float) -> "OccupancyGrid":
        """Return the window of a plan from ``corner`` on that holds all known cells, of which there is one."""
        cells = np.where(occupied, OCCUPIED, np.where(unknown, UNKNOWN, FREE)).astype(np.int8)
        known = np.argwhere(cells != UNKNOWN)
        first, last = known.min(axis=0), known.max(axis=0)
        return cls(cells[first[0] : last[0] + 1, first[1] : last[1] + 1], corner + first * cell, cell)

    def image(self) -> np.ndarray:
        """Draw the grid as ROS does: uint8 ``(ny, nx)``, the first row at the highest y."""
        grey = np.full(self.cells.shape, GREY[UNKNOWN], np.uint8)
        grey[self.cells == FREE] = GREY[FREE]
        grey[self.cells == OCCUPIED] = GREY[OCCUPIED]
        return np.ascontiguousarray(grey.T[::-1])


def _blocks(columns: np.ndarray, n: int) -> np.ndarray:
    """Group ``(nx, ny)`` columns as ``(cells x, n, cells y, n)``; a cell at the rim is filled with zeros."""
    nx, ny = (-(-size // n) for size in columns.shape)
    padded = np.zeros((nx * n, ny * n), columns.dtype)
    padded[: columns.shape[0], : columns.shape[1]] = columns
    return padded.reshape(nx, n, ny, n)


def write_ros_map(path: Path, grid: OccupancyGrid) -> None:
    """Write ``path`` (.yaml) and the image beside it (.pgm), each whole or not at all, the image first."""
    image = grid.image()
    picture = path.with_suffix(".pgm")
    with atomic_write(picture) as temporary:
        temporary.write_bytes(f"P5\n{image.shape[1]} {image.shape[0]}\n255\n".encode("ascii") + image.tobytes())
    x, y = (round(float(value), 6) for value in grid.origin)
    lines = [
        f"image: {picture.name}",
        "mode: trinary",
        f"resolution: {grid.resolution!r}",
        f"origin: [{x!r}, {y!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    ]
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
