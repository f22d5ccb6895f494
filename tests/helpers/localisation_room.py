"""Make the textured room of the alignment and tracking tests, and its map, with shapes that all modules share."""

import functools

import numpy as np

from tests.helpers.analytic_room import Room
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import VoxelMap

FURNITURE = (
    ((0.9, 0.6, 0.0), (1.4, 1.1, 0.8)),
    ((0.6, -1.3, 0.0), (1.1, -0.9, 1.3)),
    ((-1.4, 0.8, 0.0), (-0.7, 1.2, 0.6)),
)
ROOM = Room(interior=((-1.9, -1.6, 0.0), (1.9, 1.6, 2.0)), boxes=FURNITURE)
GRID = ((-2.3, -2.0, -0.4), 0.1, (48, 40, 32))
CAMERA = Camera.from_hfov(64, 48, np.radians(85))


@functools.cache
def known_map() -> VoxelMap:
    """Return the map of the whole room, made once a process, where a test asks for it."""
    return ROOM.to_map(*GRID)
