"""Show a run live in rerun's 3D viewer: camera, images, path and surface (``--viewer``; extra ``viz``).

The only module that imports rerun, and only when a viewer is opened. The world is the first camera's frame, so that x
points right, y down and z ahead in it.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.camera import Camera
from vssm_gym.viz.mesh import Mesh

HOW = "rerun: pip install -c constraints.txt '.[viz]'"  # of the error without it
PATH_EVERY = 10  # frames between two drawings of the whole path
IMAGE_DISTANCE = 0.3  # m from the camera at which its image is drawn in space
# RGB of positions, of lost ones, of the path
FOUND_COLOUR, LOST_COLOUR, TRACK_COLOUR = (11, 110, 79), (194, 24, 91), (30, 80, 160)


class Viewer:
    """Show a run; made by :func:`open_viewer`. Call ``close`` when done: it waits until everything is sent."""

    def __init__(self, rerun: Any, stream: Any, camera: Camera) -> None:
        self._rerun, self._stream = rerun, stream
        self._path: list[np.ndarray] = []
        pinhole = rerun.Pinhole(
            image_from_camera=camera.K, width=camera.width, height=camera.height, image_plane_distance=IMAGE_DISTANCE
        )
        stream.log("world", rerun.ViewCoordinates.RDF, static=True)
        stream.log("world/camera/image", pinhole, static=True)

    def frame(
        self,
        time: float,
        T_world_cam: Matrix4,
        rgb: UInt8[np.ndarray, "height width 3"],
        depth: Float[np.ndarray, "height width"],
        *,
        lost: bool = False,
        step_ms: float | None = None,
    ) -> None:
        """Show one frame.

        Args:
            time: its stamp, s; the viewer's timeline starts at the first one.
            T_world_cam: estimated pose.
            rgb: the image as the filter saw it.
            depth: z-depth, m, 0 = no reading.
            lost: whether the pose is only a guess.
            step_ms: duration of the step.
        """
        rr, stream = self._rerun, self._stream
        if not self._path:
            self._start = time
        stream.set_time("time", duration=time - self._start)
        T = np.asarray(T_world_cam, dtype=np.float64)
        stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        stream.log("world/camera/image/colour", rr.Image(rgb))
        stream.log("world/camera/image/depth", rr.DepthImage(np.asarray(depth, np.float32), meter=1.0))
        stream.log(
            "world/position", rr.Points3D([T[:3, 3]], colors=[LOST_COLOUR if lost else FOUND_COLOUR], radii=0.02)
        )
        if step_ms is not None:
            stream.log("step_ms", rr.Scalars(step_ms))
        self._path.append(T[:3, 3])
        if len(self._path) % PATH_EVERY == 0:
            self._draw_path()

    def surface(self, mesh: Mesh) -> None:
        """Show the map's current surface in place of the previous one; nothing where it has none."""
        if len(mesh.faces):
            shown = self._rerun.Mesh3D(
                vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=mesh.colours
            )
            self._stream.log("world/surface", shown)

    def close(self) -> None:
        """Send the rest, and disconnect."""
        if len(self._path) > 1:
            self._draw_path()
        self._stream.flush()
        self._stream.disconnect()

    def _draw_path(self) -> None:
        self._stream.log(
            "world/path", self._rerun.LineStrips3D([np.array(self._path)], colors=[TRACK_COLOUR], radii=0.005)
        )


def open_viewer(name: str, camera: Camera, file: Path | None = None) -> Viewer:
    """Open a viewer in its own window, or a recording in ``file`` (.rrd) for ``rerun FILE``.

    Args:
        name: of the recording, as the viewer lists it.
        camera: of the images that will be shown.
        file: write here instead of opening a window: for machines without a display.

    Raises:
        InputError: rerun is not installed, or its viewer cannot be started.
    """
    try:
        rerun: Any = importlib.import_module("rerun")  # of an extra: types may be there or not
    except ImportError as reason:
        raise InputError("--viewer", "rerun", f"{HOW} ({reason})") from reason
    stream = rerun.RecordingStream(f"vssm-gym {name}")
    try:
        if file is None:
            stream.spawn()
        else:
            stream.save(str(file))
    except (OSError, RuntimeError) as reason:
        raise InputError(
            "--viewer", "rerun", f"a viewer that can be started ({str(reason).splitlines()[0]})"
        ) from reason
    return Viewer(rerun, stream, camera)
