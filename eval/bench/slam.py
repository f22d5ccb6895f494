"""Compare our SLAM step with Open3D's dense SLAM on the same frames of a recording: ``bench slam``.

Both see the undistorted, resized images of :class:`FrameReader` at the same rate. A step is the time of a frame once
its image is read: tracking, uncertainty, map update and the rendering for the next frame. Its stages are listed too.
First steps, which compile or allocate, are not counted. Open3D runs in a process of its own, which takes the times. The
two take turns, run by run, so that a machine that slows down slows both.
"""

import functools
import os
import platform
from typing import Any

import numpy as np

from vssm_gym.data.sequences import FrameReader, Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.open3d_process import run_open3d
from vssm_gym.eval.bench.open3d_slam import STAGES
from vssm_gym.model.emission import MAX_DEPTH
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import SlamRun, prefetch, run_slam, thin

# Image sizes, and the voxel (m) that Open3D gets at each: those of its published dense pipelines, finer with the image.
OPEN3D_VOXEL = {(160, 120): 0.03, (320, 240): 0.02}
FRAME_RATE = 10.0  # frames a second
OURS = ("track", "map", "reference", "recover")  # stages of our step; Open3D's are in open3d_slam.STAGES
ASTRAY_ERROR = 0.05  # m: a frame with a larger error counts as astray


def compare(sequence: Sequence, *, trials: int = 1, voxel: float = 0.07, on_progress: OnProgress | None = None) -> dict:
    """Run both ``trials`` times at every size that the recording has.

    Args:
        sequence: a recording; errors need its ground truth.
        trials: runs of each at each size; times are of all runs, errors of the last.
        voxel: of our map, m.
        on_progress: called after every frame.

    Returns:
        ``rows``: one dict a method and size, see :func:`_row`; ``missing``: why Open3D was not run, or None;
        ``notices``: faults of the recording; the machine.

    Raises:
        InputError: a recording whose images are smaller than the smallest size.
    """
    size_of = (sequence.camera.width, sequence.camera.height)
    sizes = [size for size in OPEN3D_VOXEL if size[0] <= size_of[0] and size[1] <= size_of[1]]
    if not sizes:
        raise InputError(sequence.root, "size", f"images of at least 160x120, not {size_of[0]}x{size_of[1]}")
    missing: str | None = None
    rows = []
    for size in sizes:
        ours: list[dict[str, np.ndarray]] = []
        theirs: list[dict[str, np.ndarray]] = []
        for _ in range(trials):
            report = None if on_progress is None else functools.partial(_report, on_progress)
            run = run_slam(sequence, SlamOptions(size=size, rate=FRAME_RATE, voxel=voxel), on_progress=report)
            ours.append(_stages(run))
            if missing is None:
                try:
                    poses_theirs, failed, seconds = _theirs(sequence, size, on_progress)
                    theirs.append(seconds)
                except InputError as reason:
                    missing = str(reason)
        rows.append(_row("vssm-gym", size, voxel, ours, _errors(sequence, run.times, run.poses)))
        if theirs:
            row = _row("Open3D", size, OPEN3D_VOXEL[size], theirs, _errors(sequence, *poses_theirs))
            rows.append(row | {"odometry_failures": failed})
    notices = list(run.notices)
    machine = {"cores": os.cpu_count(), "processor": platform.machine()}
    result = {"scene": sequence.root.name, "rate": FRAME_RATE, "rows": rows, "missing": missing}
    return result | {"notices": notices, "machine": machine}


def _stages(run: SlamRun) -> dict[str, np.ndarray]:
    """Return the seconds of every step that does not compile, whole and by stage, where the stage ran."""
    warm = [frame for frame in run.frames if frame.warm]
    ran = {name for frame in warm for name in frame.stages}
    seconds = {name: np.array([f.stages[name] for f in warm if name in f.stages]) for name in OURS if name in ran}
    return {"step": np.array([frame.step_s for frame in warm])} | seconds


def _report(on_progress: OnProgress, _: str, done: int, total: int) -> None:
    on_progress("vssm-gym", done, total)


def _theirs(
    sequence: Sequence, size: tuple[int, int], on_progress: OnProgress | None
) -> tuple[tuple[np.ndarray, np.ndarray], int, dict[str, np.ndarray]]:
    """Run Open3D; return (times, poses), failures of its odometry, and the seconds of every step after the first."""
    reader, indices = FrameReader(sequence, size), thin(sequence.times, FRAME_RATE)
    frames = ((rgb, depth) for rgb, depth, _ in prefetch(reader, indices))
    report = None if on_progress is None else lambda version, done: on_progress(f"Open3D {version}", done, len(indices))
    run = run_open3d(frames, reader.camera, OPEN3D_VOXEL[size], MAX_DEPTH, on_progress=report)
    seconds = run.seconds[1:]
    by_stage = {"step": seconds.sum(axis=1)} | {stage: seconds[:, i] for i, stage in enumerate(STAGES)}
    return (sequence.times[indices], run.poses), run.failed, by_stage


def _row(
    method: str, size: tuple[int, int], voxel: float, runs: list[dict[str, np.ndarray]], errors: dict[str, Any]
) -> dict[str, Any]:
    """Build a row: the method, ``stages_ms`` (median ``p50`` and ``p95`` over all runs), and the errors."""
    stages = {}
    for stage in dict.fromkeys(name for run in runs for name in run):
        p50, p95 = 1e3 * np.percentile(np.concatenate([run[stage] for run in runs if stage in run]), [50, 95])
        stages[stage] = {"p50": float(p50), "p95": float(p95)}
    return {"method": method, "size": list(size), "voxel": voxel, "stages_ms": stages, **errors}


def _errors(sequence: Sequence, times: np.ndarray, poses: np.ndarray) -> dict[str, Any]:
    """Return ``ate_m`` (RMSE) and ``ate_max_m`` after SE(3) alignment, and ``astray``.

    That is the number of frames with errors above ASTRAY_ERROR.

    All are None without ground truth.
    """
    if sequence.truth is None:
        return {"ate_m": None, "ate_max_m": None, "astray": None}
    of_est, of_true = trajectory_error.associate(times, sequence.truth[0])
    if len(of_est) < 3:
        return {"ate_m": None, "ate_max_m": None, "astray": None}
    off = trajectory_error.ate(poses[of_est], sequence.truth[1][of_true]).translation
    statistics = trajectory_error.Statistics.of(off)
    return {"ate_m": statistics.rmse, "ate_max_m": statistics.max, "astray": int(np.sum(off > ASTRAY_ERROR))}
