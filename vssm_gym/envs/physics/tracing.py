"""Find the first box along rays ``p(t) = o + t d``, for laser scanners and coverage.

Images are rasterised instead (:mod:`vssm_gym.envs.rendering.raster`). This is the only module that imports Embree.
"""

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vssm_gym.envs.scenes.solids import SolidBox

if TYPE_CHECKING:
    from vssm_gym.envs.physics import FlightWorld, FloorWorld


_TRIANGLES = 12  # a box


class Tracer(Protocol):
    """Find the first box along rays that leave one point.

    ``trace(origin (3,), directions (n, 3))``, float32 directions, returns ``t`` float32 ``(n,)`` in multiples of the
    direction and the box's index int32 ``(n,)``; where nothing is hit ``t`` is 0 and the index -1. World frame, m.
    """

    name: str  # recorded with results
    parallel: bool  # True if trace may run in several threads at once

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first hits of the rays ``origin + t direction``."""


class EmbreeTracer:
    """Trace with Embree over the boxes' faces; raise ImportError where embreex has no wheel or cannot be loaded."""

    name = "embree"
    parallel = True

    def __init__(self, boxes: Sequence[SolidBox]) -> None:
        self._boxes = list(boxes)
        self._build()

    def _build(self) -> None:
        from embreex import mesh_construction, rtcore_scene

        vertices, triangles = box_mesh(self._boxes)
        self._scene = rtcore_scene.EmbreeScene(robust=True)  # no ray slips between two triangles of a face
        mesh_construction.TriangleMesh(self._scene, vertices, triangles)

    def __getstate__(self) -> dict[str, Any]:
        return {"_boxes": self._boxes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._boxes = state["_boxes"]
        self._build()

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first hits of the rays ``origin + t direction``; see :class:`Tracer`."""
        origins = np.empty_like(directions)
        origins[:] = origin
        hits = self._scene.run(origins, directions, output=1)
        missed = hits["primID"] < 0
        t, box = hits["tfar"], hits["primID"] // _TRIANGLES
        t[missed], box[missed] = 0.0, -1
        return t, box


class MujocoTracer:
    """Trace with ``mj_multiRay`` over the same boxes: slower, for machines without Embree."""

    name = "mujoco"
    parallel = False

    def __init__(self, world: "FloorWorld | FlightWorld") -> None:
        self._world = world

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first hits of the rays ``origin + t direction``; see :class:`Tracer`."""
        t, box = self._world.multi_ray(origin, directions)
        return t.astype(np.float32), box


def box_mesh(boxes: Sequence[SolidBox]) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes' faces.

    Vertices float32 ``(8 n, 3)``, world frame, m, and triangles int32 ``(12 n, 3)``, box by box.
    """
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))  # corner 4 x + 2 y + z
    faces = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    vertices = np.empty((len(boxes), 8, 3))
    for i, box in enumerate(boxes):
        c, s = math.cos(box.yaw), math.sin(box.yaw)
        R_world_box = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        vertices[i] = (corners * box.size) @ R_world_box.T + box.center
    quads = faces + 8 * np.arange(len(boxes))[:, None, None]
    triangles = quads.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]]
    return vertices.reshape(-1, 3).astype(np.float32), triangles.reshape(-1, 3).astype(np.int32)
