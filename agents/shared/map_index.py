"""Index a known map for relocalisation, at places on its floor plan; built when it is first asked for.

Most robots are never lost, and an index takes seconds. It is kept over episodes, as long as map and camera stay.
"""

import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.relocalisation.relocaliser import Relocaliser
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap

SPACING = 0.25  # m between places


class MapIndex:
    """Keep the relocaliser of the last map."""

    def __init__(self) -> None:
        self._map: VoxelMap | None = None
        self._key: tuple[bytes, ...] = ()
        self._made: Relocaliser

    def relocaliser(self, context: AgentContext) -> Relocaliser:
        """Return the relocaliser of the context's map and camera; raise :class:`InputError` without a map."""
        if context.map is None:
            raise InputError("AgentContext", "map", "a learned map: robots are relocalised in one")
        key = tuple(np.asarray(a).tobytes() for a in (context.K, context.camera, context.T_body_cam))
        if context.map is not self._map or key != self._key:
            places = free_places(ClearanceMap.from_voxel_map(context.map), 0.5 * context.body_length)
            self._made = Relocaliser.of(context.map, rig_of(context), places)
            self._map, self._key = context.map, key
        return self._made


def free_places(space: ClearanceMap, radius: float, spacing: float = SPACING) -> np.ndarray:
    """Return places on a grid where a disc is free.

    Args:
        space: the floor plan.
        radius: of the disc, m.
        spacing: of the grid, m.

    Returns:
        ``(n, 2)``, m; the freest cell of the plan where the grid has none.
    """
    low, high = space.origin, space.to_world(np.array(space.clearance.shape) - 1)
    x, y = (np.arange(low[a] + 0.5 * spacing, high[a], spacing) for a in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    free = grid[space.at(grid) >= radius]
    if len(free):
        return free
    freest = np.unravel_index(int(np.argmax(space.clearance)), space.clearance.shape)
    return space.to_world(np.array(freest))[None]


def rig_of(context: AgentContext) -> Rig:
    """Return the camera on the robot's body."""
    return Rig.of(Camera.from_matrix(context.K, *context.camera), context.T_body_cam)
