"""Run PRISM and the smoother over one recording, and measure both: poses, their covariances, and the maps.

A map is judged by images that neither has seen: the filter gets every second image of a recording, or fewer. Their
true poses are brought into the world of each map by the alignment of its own trajectory, so that a map is not judged
by where its world lies.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np

from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.pose_calibration import inside_region
from vssm_gym.eval.studies.calibration.recordings import errors_of, stated
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.mapping.views import Views, fit_scales, held_out
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.refinement import refine
from vssm_gym.slam.run import SlamRun, run_slam

JUDGED_VIEWS = 40  # held-out images at most
SOURCE = "study smoothing"


def compare(recording: Sequence, options: SlamOptions, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Measure the filter and the smoother on a recording with ground truth.

    Args:
        recording: its images come faster than ``options.rate``, or none are left to judge the maps by.
        options: of the filter.
        on_progress: called while images are read, tracked, smoothed and mapped.

    Returns:
        The fields of :class:`~vssm_gym.eval.studies.smoothing.table.StoredRow`.

    Raises:
        InputError: no ground truth, or no more than two frames that are tracked.
    """
    if recording.truth is None:
        raise InputError(recording.root / "groundtruth.txt", "file", "ground-truth poses, which this study needs")
    true = recording.true_poses()
    began = time.perf_counter()
    filtered = run_slam(recording, options, on_progress=on_progress)
    seconds = time.perf_counter() - began
    refined = refine(filtered, options, on_progress)
    unused = np.setdiff1d(np.arange(len(recording.frames)), [frame.index for frame in filtered.frames])
    last = filtered.frames[-1].index
    unused = unused[unused < last]
    judged = unused[np.unique(np.linspace(0, len(unused) - 1, JUDGED_VIEWS).round().astype(int))] if len(unused) else []
    measure = lambda run: _measured(run, recording, true, np.asarray(judged, int), options.max_depth)
    used = true[[frame.index for frame in filtered.frames], :3, 3]
    return {
        "seconds": float(filtered.times[-1] - filtered.times[0]),
        "length_m": float(np.linalg.norm(np.diff(used, axis=0), axis=1).sum()),
        "frames": len(filtered.frames),
        "lost": int(filtered.lost.sum()),
        "smoothed_frames": len(refined.nodes),
        "filter": measure(filtered) | {"seconds": seconds},
        "smoother": measure(refined.run) | {"seconds": refined.seconds},
    }


def _measured(
    run: SlamRun, recording: Sequence, true: np.ndarray, judged: np.ndarray, max_depth: float
) -> dict[str, Any]:
    """Return the errors of poses and map of one run; those of the map are None without images to judge it by."""
    assert recording.truth is not None
    indices = np.array([frame.index for frame in run.frames])
    errors = trajectory_error.ate(run.poses, true[indices])
    found = errors_of(stated(run, recording.truth))
    d = found.residuals.shape[1]
    poses = {
        "ate_m": float(np.sqrt(np.mean(errors.translation**2))),
        "max_m": float(errors.translation.max()),
        "rotation_deg": float(np.sqrt(np.mean(errors.rotation**2))),
        "nees": float(found.nees.mean()) / d,
        "inside": float(inside_region(found.nees, d).mean()),
    }
    if not len(judged):
        return poses | dict.fromkeys(("depth_l1", "log_likelihood", "hit_share"))
    reader, tracked = run.reader, np.flatnonzero(~run.lost)
    # Of the frames that the map was made of: a guess at a lost one says nothing of where the map lies.
    alignment = trajectory_error.align(run.poses[tracked, :3, 3], true[indices[tracked], :3, 3])
    A = np.eye(4)
    A[:3, :3], A[:3, 3] = alignment.rotation, alignment.translation
    shown = tracked[np.unique(np.linspace(0, len(tracked) - 1, JUDGED_VIEWS).round().astype(int))]
    fitted = Views.stack([reader[int(indices[i])] for i in shown], run.poses[shown], reader.camera)
    views = Views.stack([reader[int(i)] for i in judged], inverse(A) @ true[judged], reader.camera)
    m = replace(run.map, pose_errors=None)
    judgement = held_out(m, views, fit_scales(m, fitted, max_depth), max_depth)
    return poses | {
        "depth_l1": judgement.depth_l1 if np.isfinite(judgement.depth_l1) else None,
        "log_likelihood": judgement.log_likelihood,
        "hit_share": judgement.hit_share,
    }
