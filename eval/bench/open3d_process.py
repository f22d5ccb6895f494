"""Run Open3D's SLAM in a process of its own and report its end as an error with a message.

The program is :mod:`vssm_gym.eval.bench.open3d_slam`, whose documentation defines the messages.
"""

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera

COMMAND = (sys.executable, "-m", "vssm_gym.eval.bench.open3d_slam")
LEAVE_SECONDS = 30.0  # s that the process has to end after its last frame


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
    with tempfile.TemporaryFile() as errors, _started(command, errors) as process:
        try:
            opening = json.dumps(setup | {"voxel": voxel, "max_depth": max_depth}).encode() + b"\n"
            begun = _ask(process, opening)
            if "error" in begun:
                raise InputError("bench slam", "open3d", str(begun["error"]))
            for rgb, depth in frames:
                frame = (
                    np.ascontiguousarray(rgb, np.uint8).tobytes() + np.ascontiguousarray(depth, np.float32).tobytes()
                )
                answers.append(_ask(process, frame, "pose", "failed", "seconds"))
                if on_progress:
                    on_progress(str(begun.get("version", "")), len(answers))
        except _NoAnswerError as error:
            raise InputError("bench slam", "open3d", _ending(process, errors, len(answers))) from error
    return Open3dRun(
        str(begun.get("version", "")),
        np.array([answer["pose"] for answer in answers]).reshape(-1, 4, 4),
        sum(answer["failed"] for answer in answers),
        np.array([answer["seconds"] for answer in answers]).reshape(-1, 3),
    )


class _NoAnswerError(Exception):
    """Signal a broken pipe, an empty line, or a line that is not an answer."""


def _ask(process: subprocess.Popen[bytes], message: bytes, *names: str) -> dict[str, Any]:
    """Send a message and return the answer, which holds ``names``."""
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.write(message)
        process.stdin.flush()
        answer = json.loads(process.stdout.readline())
    except (OSError, ValueError) as error:
        raise _NoAnswerError from error
    if not isinstance(answer, dict) or not answer.keys() >= set(names):
        raise _NoAnswerError
    return answer


@contextlib.contextmanager
def _started(command: Sequence[str], errors: IO[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process and end it with the block, also after an error."""
    process: Any = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors)
    try:
        yield process
        process.stdin.close()  # its input ends, and so does it
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(LEAVE_SECONDS)
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):  # what was not yet sent to a dead process
                if pipe is not None:
                    pipe.close()


def _ending(process: subprocess.Popen[bytes], errors: IO[bytes], done: int) -> str:
    """Describe how the process ended, with its last line on standard error."""
    try:
        code = process.wait(1.0)
    except subprocess.TimeoutExpired:
        how = "gave an answer that cannot be read"
    else:
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    errors.seek(0)
    said = errors.read().decode(errors="replace").strip().splitlines()
    return f"a process that lives to the end; Open3D's {how} after {done} frames{f' ({said[-1]})' if said else ''}"
