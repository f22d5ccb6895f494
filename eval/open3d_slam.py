"""Open3D's dense RGB-D SLAM behind the few calls that a comparison needs; the only module that imports Open3D.

Frame-to-model odometry against a ray-cast image of a truncated signed distance field in voxel blocks, in C++: the
pipeline of Open3D's own ``dense_slam`` example with its defaults. It has no notion of being lost and no uncertainty.
"""

import importlib
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.camera import Camera
from vssm_gym.errors import InputError

HOW = "Open3D: pip install open3d, and on Debian apt install libusb-1.0-0 libgl1"
TRUNCATION = 8.0  # voxels, Open3D's default
BLOCKS = 20_000  # of 16^3 voxels; the grid grows where they do not suffice
MIN_DEPTH = 0.1  # m, Open3D's default
JUMP = 0.07  # m between the depths of associated pixels at most, Open3D's default
UNITS = 5000.0  # of depth a metre
STAGES = ("track", "integrate", "ray cast")


@dataclass(frozen=True)
class Open3dStep:
    """One frame."""

    T_world_cam: Float[np.ndarray, "4 4"]  # world: the first camera's frame
    failed: bool  # its odometry raised an error; the pose is the last one
    seconds: tuple[float, float, float]  # of STAGES


class Open3dSlam:
    """The filter's state between frames.

    Args:
        camera: of all images.
        voxel: m.
        max_depth: m; farther readings are left out.

    Raises:
        InputError: Open3D cannot be imported; the message says how to install it.
    """

    def __init__(self, camera: Camera, voxel: float, max_depth: float) -> None:
        try:
            open3d: Any = importlib.import_module("open3d")  # not part of any extra: types may be there or not
        except (ImportError, OSError) as reason:
            raise InputError("bench slam", "open3d", f"{HOW} ({str(reason).splitlines()[0]})") from reason
        open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
        self._open3d, self.version = open3d, str(open3d.__version__)
        self._max_depth = max_depth
        slam = open3d.t.pipelines.slam
        device, tensor = open3d.core.Device("CPU:0"), open3d.core.Tensor
        self._T_world_cam = np.eye(4)
        self._model = slam.Model(voxel, 16, BLOCKS, tensor(self._T_world_cam), device)
        size = (camera.height, camera.width, tensor(camera.K), device)
        self._seen, self._cast = slam.Frame(*size), slam.Frame(*size)
        self._frames = 0

    def step(self, rgb: UInt8[np.ndarray, "height width 3"], depth: Float[np.ndarray, "height width"]) -> Open3dStep:
        """Localise an image, add it to the map and ray-cast the map for the next one."""
        tensor, image = self._open3d.core.Tensor, self._open3d.t.geometry.Image
        units = np.rint(np.minimum(depth, 65535 / UNITS) * UNITS).astype(np.uint16)
        self._seen.set_data_from_image("depth", image(tensor(units)))
        self._seen.set_data_from_image("color", image(tensor(np.ascontiguousarray(rgb))))
        failed, start = False, time.perf_counter()
        if self._frames:
            try:
                found = self._model.track_frame_to_model(self._seen, self._cast, UNITS, self._max_depth, JUMP)
                self._T_world_cam = self._T_world_cam @ found.transformation.numpy()
            except RuntimeError:  # too few matches: a singular system
                failed = True
        tracked = time.perf_counter()
        self._model.update_frame_pose(self._frames, tensor(self._T_world_cam))
        self._model.integrate(self._seen, UNITS, self._max_depth, TRUNCATION)
        integrated = time.perf_counter()
        self._model.synthesize_model_frame(self._cast, UNITS, MIN_DEPTH, self._max_depth, TRUNCATION, False)
        cast = time.perf_counter()
        self._frames += 1
        return Open3dStep(self._T_world_cam, failed, (tracked - start, integrated - tracked, cast - integrated))
