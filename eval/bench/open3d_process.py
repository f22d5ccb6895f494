"""Run Open3D's SLAM in a process of its own and report its end as an error with a message.

The program is :mod:`vssm_gym.eval.bench.open3d_slam`, whose documentation defines the messages.
"""

import json
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.foreign_process import ForeignProcess
from vssm_gym.geometry.camera import Camera

COMMAND = (sys.executable, "-m", "vssm_gym.eval.bench.open3d_slam")


@dataclass(frozen=True)
class Open3dRun:
    """Hold the process's answers, a row a frame."""

    version: str
    poses: Float[np.ndarray, "n 4 4"]  # T_world_cam; world: the first camera's frame
    failed: int  # frames whose odometry raised an error; their pose is that of the frame before
    seconds: Float[np.ndarray, "n 3"]  # of ``open3d_slam.STAGES``


def run_open3d(
    frames: Iterable[tuple[np.ndarray, np.ndarray]],
    camera: Camera,
    voxel: float,
    max_depth: float,
    *,
    on_progress: Callable[[str, int], None] | None = None,
    command: Sequence[str] = COMMAND,
) -> Open3dRun:
    """Send every frame to a process of its own and collect the answers.

    Args:
        frames: RGB uint8 ``(height, width, 3)`` and depth float32 ``(height, width)``, m.
        camera: of all frames.
        voxel: of its map, m.
        max_depth: m; farther readings are left out.
        on_progress: called with the version and the number of frames done, after each.
        command: the program.

    Raises:
        InputError: Open3D is not installed, the process died, or an answer could not be read.
    """
    setup = {"width": camera.width, "height": camera.height, "K": np.asarray(camera.K).tolist()}
    answers: list[dict[str, Any]] = []
    with ForeignProcess(command, "bench slam", "open3d", "Open3D", "frames") as process:
        begun = process.begin(json.dumps(setup | {"voxel": voxel, "max_depth": max_depth}).encode() + b"\n")
        for rgb, depth in frames:
            frame = np.ascontiguousarray(rgb, np.uint8).tobytes() + np.ascontiguousarray(depth, np.float32).tobytes()
            answers.append(process.ask(frame, "pose", "failed", "seconds"))
            if on_progress:
                on_progress(str(begun.get("version", "")), len(answers))
    return Open3dRun(
        str(begun.get("version", "")),
        np.array([answer["pose"] for answer in answers]).reshape(-1, 4, 4),
        sum(answer["failed"] for answer in answers),
        np.array([answer["seconds"] for answer in answers]).reshape(-1, 3),
    )
