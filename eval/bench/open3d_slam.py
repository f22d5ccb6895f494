"""Run Open3D's dense RGB-D SLAM as a program of its own; the only module that imports Open3D.

    python -m vssm_gym.eval.bench.open3d_slam

On standard input it takes one line of JSON (``width, height, K, voxel, max_depth``), then frames: colour as bytes
``(height, width, 3)`` and depth as float32 ``(height, width)``, m. It answers with one line of JSON for each: first its
``version`` or an ``error``, then ``pose`` (T_world_cam), ``failed`` and ``seconds`` of every frame. The other end is
:mod:`vssm_gym.eval.bench.open3d_process`; in one process with JAX the library has caused segmentation faults.

Frame-to-model odometry against a ray-cast image of a truncated signed distance field in voxel blocks, in C++: the
pipeline of Open3D's own ``dense_slam`` example with its defaults. It detects no loss of track and estimates no
uncertainty.
"""

import importlib
import json
import os
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

HOW = "Open3D: pip install open3d, and on Debian apt install libusb-1.0-0 libgl1"
OPEN3D_TRUNCATION = 8.0  # voxels, Open3D's default
BLOCKS = 20_000  # initial number of blocks of 16^3 voxels; the grid grows
OPEN3D_MIN_DEPTH = 0.1  # m, Open3D's default
DEPTH_JUMP = 0.07  # m: largest difference of associated depths, Open3D's default
UNITS = 5000.0  # units of depth images a metre
STAGES = ("track", "integrate", "ray cast")


@dataclass(frozen=True)
class Open3dStep:
    """Hold the result of one frame."""

    T_world_cam: Float[np.ndarray, "4 4"]  # world: the first camera's frame
    failed: bool  # its odometry raised an error; the pose is the last one
    seconds: tuple[float, float, float]  # of STAGES


class Open3dSlam:
    """Hold the state between frames; raises ImportError or OSError where Open3D is not installed.

    Args:
        width: of all images, pixels.
        height: likewise.
        K: intrinsic matrix, pixels.
        voxel: m.
        max_depth: m; farther readings are left out.
    """

    def __init__(self, width: int, height: int, K: Float[np.ndarray, "3 3"], voxel: float, max_depth: float) -> None:
        open3d: Any = importlib.import_module("open3d")  # not part of any extra: types may be there or not
        open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
        self._open3d, self.version = open3d, str(open3d.__version__)
        self._max_depth = max_depth
        slam = open3d.t.pipelines.slam
        device, tensor = open3d.core.Device("CPU:0"), open3d.core.Tensor
        self._T_world_cam = np.eye(4)
        self._model = slam.Model(voxel, 16, BLOCKS, tensor(self._T_world_cam), device)
        size = (height, width, tensor(np.ascontiguousarray(K, dtype=np.float64)), device)
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
                found = self._model.track_frame_to_model(self._seen, self._cast, UNITS, self._max_depth, DEPTH_JUMP)
                self._T_world_cam = self._T_world_cam @ found.transformation.numpy()
            except RuntimeError:  # too few matches: a singular system
                failed = True
        tracked = time.perf_counter()
        self._model.update_frame_pose(self._frames, tensor(self._T_world_cam))
        self._model.integrate(self._seen, UNITS, self._max_depth, OPEN3D_TRUNCATION)
        integrated = time.perf_counter()
        self._model.synthesize_model_frame(
            self._cast, UNITS, OPEN3D_MIN_DEPTH, self._max_depth, OPEN3D_TRUNCATION, False
        )
        cast = time.perf_counter()
        self._frames += 1
        return Open3dStep(self._T_world_cam, failed, (tracked - start, integrated - tracked, cast - integrated))


def main() -> None:
    """Answer the frames of one recording until the input ends; see the module."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the library's own output must not mix with answers
    source = sys.stdin.buffer
    setup = json.loads(source.readline())
    width, height = setup["width"], setup["height"]
    try:
        slam = Open3dSlam(width, height, np.array(setup["K"]), setup["voxel"], setup["max_depth"])
    except (ImportError, OSError) as reason:
        print(json.dumps({"error": f"{HOW} ({str(reason).splitlines()[0]})"}), file=answers, flush=True)
        return
    print(json.dumps({"version": slam.version}), file=answers, flush=True)
    pixels = width * height
    while len(frame := source.read(7 * pixels)) == 7 * pixels:
        rgb = np.frombuffer(frame, np.uint8, 3 * pixels).reshape(height, width, 3)
        depth = np.frombuffer(frame, np.float32, pixels, 3 * pixels).reshape(height, width)
        step = slam.step(rgb, depth)
        answer = {"pose": step.T_world_cam.tolist(), "failed": step.failed, "seconds": step.seconds}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
