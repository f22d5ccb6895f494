"""The raycast camera: one ray a pixel to the first box, ``p(d) = c + d R K^-1 [i, j, 1]^T``, then a texture and light.

Rays are traced by Embree over the boxes' faces; this is the only module that imports it. Equal inputs
give equal bytes, whatever the number of threads.
"""

import itertools
import math
import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vssm_gym.axes import Matrix4
from vssm_gym.camera import Camera
from vssm_gym.envs.embree_packets import PacketScene, find_library
from vssm_gym.envs.shading import rotate, shade, shading_tables
from vssm_gym.envs.solids import SolidBox

if TYPE_CHECKING:
    from vssm_gym.envs.mjcf import FlightWorld, World

_TILE = 4  # pixels
_BANDS = 2  # bands of rows a thread takes: interleaved, so that floor and ceiling are shared evenly


class Tracer(Protocol):
    """Finds the first box along rays that leave one point.

    ``trace(origin (3,), directions (n, 3))`` gives ``t`` float32 ``(n,)`` in multiples of the direction and the box's
    index int32 ``(n,)``; where nothing is hit ``t`` is 0 and the index -1. All in the world frame, m.
    """

    name: str  # recorded with results
    parallel: bool  # whether trace may run in several threads at once

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of the rays ``origin + t direction``."""


class EmbreeTracer:
    """Embree over the boxes' faces; raises ImportError where embreex has no wheel or cannot be loaded.

    Rays go in packets of sixteen (``packets``) where that is possible and proves equal to embreex's own single-ray
    call, else through that call, up to four times slower.
    """

    name = "raycast-embree"
    parallel = True

    def __init__(self, boxes: Sequence[SolidBox]) -> None:
        self._boxes = list(boxes)
        self.use_packets = True  # where they are within reach; a benchmark compares both
        self._build()

    def _build(self) -> None:
        import embreex
        from embreex import mesh_construction, rtcore_scene

        vertices, quads = box_mesh(self._boxes)
        triangles = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)
        self._single = rtcore_scene.EmbreeScene(robust=True)  # no ray slips between two triangles of a face
        mesh_construction.TriangleMesh(self._single, vertices, triangles)
        self._packets: PacketScene | None = None
        try:
            packets = PacketScene(find_library(Path(embreex.__file__).parent), vertices, quads)
            self._compare(packets)
            self._packets = packets
        except OSError as reason:
            message = f"Embree's ray packets are out of reach ({reason}): images are traced ray by ray, slower"
            warnings.warn(message, RuntimeWarning, stacklevel=2)

    def _compare(self, packets: PacketScene) -> None:
        """Raise OSError unless packets and single rays agree on a fan of rays from among the boxes."""
        rng = np.random.default_rng(0)
        origin = np.mean([box.center for box in self._boxes], axis=0)
        directions = rng.standard_normal((500, 3)).astype(np.float32)
        (t, box), (t_single, box_single) = packets.trace(origin, directions), self._trace_single(origin, directions)
        # Depths must agree. Indices need not where boxes coincide, so only hits and misses are compared.
        if np.abs(t - t_single).max() > 1e-4 or ((box < 0) != (box_single < 0)).any():
            raise OSError("its packets and its single rays disagree")

    def __getstate__(self) -> dict[str, Any]:
        return {"_boxes": self._boxes, "use_packets": self.use_packets}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()

    @property
    def packets(self) -> bool:
        """Whether rays are traced in packets."""
        return self._packets is not None and self.use_packets

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of the rays ``origin + t direction``; see :class:`Tracer`."""
        if self._packets is not None and self.use_packets:
            return self._packets.trace(origin, directions)
        return self._trace_single(origin, directions)

    def _trace_single(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        origins = np.empty_like(directions)
        origins[:] = origin
        hits = self._single.run(origins, directions, output=1)
        missed = hits["primID"] < 0
        t, box = hits["tfar"], hits["primID"] // 12
        t[missed], box[missed] = 0.0, -1
        return t, box


class MujocoTracer:
    """``mj_multiRay`` over the same boxes: slower, for machines without Embree."""

    name = "raycast-mujoco"
    parallel = False

    def __init__(self, world: "World | FlightWorld") -> None:
        self._world = world

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of the rays ``origin + t direction``; see :class:`Tracer`."""
        t, box = self._world.multi_ray(origin, directions)
        return t.astype(np.float32), box


class RaycastCamera:
    """Renders the boxes as a pinhole camera sees them; one image at a time.

    Args:
        boxes: the solid boxes, in the order that the tracer's indices refer to.
        camera: intrinsics; their size is that of the images.
        tracer: where rays hit; by default an :class:`EmbreeTracer` over ``boxes``.
        threads: threads that share an image's rows; by default two where there are two cores.
    """

    def __init__(
        self,
        boxes: Sequence[SolidBox],
        camera: Camera,
        tracer: Tracer | None = None,
        threads: int | None = None,
    ) -> None:
        self.camera = camera
        self.tracer: Tracer = EmbreeTracer(boxes) if tracer is None else tracer
        wanted = min(2, os.cpu_count() or 1) if threads is None else threads
        self.threads = max(1, wanted) if self.tracer.parallel else 1
        self._tables = shading_tables(boxes)
        self._size = 1.0 / float(camera.K[0, 0])  # m, width of a pixel at depth 1
        # Rays go in tiles of 4x4 pixels, the neighbours that make a coherent packet.
        row, column = np.divmod(np.arange(camera.height * camera.width), camera.width)
        self._pixel_of_ray = np.lexsort((column % _TILE, row % _TILE, column // _TILE, row // _TILE))
        rays = np.asarray(camera.rays(), dtype=np.float32).reshape(-1, 3)
        self._rays = np.ascontiguousarray(rays[self._pixel_of_ray])
        bands = 1 if self.threads == 1 else _BANDS * self.threads
        edges = _TILE * camera.width * np.linspace(0, math.ceil(camera.height / _TILE), bands + 1).round().astype(int)
        self._bands = [slice(a, b) for a, b in itertools.pairwise(edges)]
        self._pool: ThreadPoolExecutor | None = None

    @property
    def name(self) -> str:
        """What traces the rays, to be recorded with results: ``raycast-embree`` or ``raycast-mujoco``."""
        return self.tracer.name

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pool": None}

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """The image at a camera pose.

        Args:
            T_world_cam: ``(4, 4)``, m.

        Returns:
            ``rgb`` uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)`` in m, 0 where a ray hits nothing.
        """
        height, width = self.camera.height, self.camera.width
        rgb = np.empty((height * width, 3), dtype=np.uint8)
        depth = np.empty(height * width, dtype=np.float32)
        T = np.ascontiguousarray(T_world_cam, dtype=np.float64)
        others = []
        if self.threads > 1:
            if self._pool is None:
                self._pool = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="raycast")
            others = [
                self._pool.submit(self._render, T, self._bands[k :: self.threads], rgb, depth)
                for k in range(1, self.threads)
            ]
        self._render(T, self._bands[:: self.threads], rgb, depth)
        for other in others:
            other.result()
        return rgb.reshape(height, width, 3), depth.reshape(height, width)

    def close(self) -> None:
        """Let go of the threads; the next image starts new ones."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def _render(self, T: np.ndarray, bands: list[slice], rgb: np.ndarray, depth: np.ndarray) -> None:
        frames, looks, textures, mips, starts = self._tables
        for band in bands:
            directions = np.empty_like(self._rays[band])
            rotate(T, self._rays[band], directions)
            t, box = self.tracer.trace(T[:3, 3], directions)
            pixels = self._pixel_of_ray[band]
            depth[pixels] = t  # the rays have unit z in the camera frame
            shade(T, directions, t, box, pixels, frames, looks, textures, mips, starts, self._size, rgb)


def box_mesh(boxes: Sequence[SolidBox]) -> tuple[np.ndarray, np.ndarray]:
    """The boxes' faces: vertices float32 ``(8 n, 3)``, world frame, m, and quads uint32 ``(6 n, 4)``, box after box."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))  # corner 4 x + 2 y + z
    faces = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    vertices = np.empty((len(boxes), 8, 3))
    for i, box in enumerate(boxes):
        c, s = math.cos(box.yaw), math.sin(box.yaw)
        R_world_box = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        vertices[i] = (corners * box.size) @ R_world_box.T + box.center
    quads = faces + 8 * np.arange(len(boxes))[:, None, None]
    return vertices.reshape(-1, 3).astype(np.float32), quads.reshape(-1, 4).astype(np.uint32)
