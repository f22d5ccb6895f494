"""Run the filter of ``vssm-gym slam`` on recordings with ground truth, and compare what it states with the truth.

A = T_est_0 T_true_0^-1 puts the truth into the world of the estimate: the first pose is known, so drift counts
e_i = log(T_est_i^-1 A T_true_i)
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.data.sequences import Sequence
from vssm_gym.data.trajectories import interpolate, velocities
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.calibration.errors import FilterErrors, RunErrors
from vssm_gym.geometry.transforms import inverse
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.calibration import pose_residuals, segments
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import SlamRun, run_slam
from vssm_gym.slam.states import POSE, VELOCITY


@dataclass(frozen=True)
class Estimates:
    """Hold what the filter states at every frame of a recording, and the recording's ground truth.

    Attributes:
        times: of the frames, s.
        T_world_cam: estimated poses; the world is the first camera's frame.
        velocity: linear (m/s) and angular (rad/s), world; NaN at frames without a belief.
        covariance: of the pose's tangent and the velocity; NaN at frames without a belief.
        accepted: True for a frame that is not lost.
        truth: times (s) and poses of the ground truth.
    """

    times: Float[np.ndarray, "n"]
    T_world_cam: Float[np.ndarray, "n 4 4"]
    velocity: Float[np.ndarray, "n 6"]
    covariance: Float[np.ndarray, "n 12 12"]
    accepted: Bool[np.ndarray, "n"]
    truth: tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 4 4"]]


def estimate(recording: Sequence, options: SlamOptions, on_progress: OnProgress | None = None) -> Estimates:
    """Run the filter over a recording.

    Raises:
        InputError: no ground truth, or no frame that can be read.
    """
    if recording.truth is None:
        raise InputError(recording.root / "groundtruth.txt", "file", "ground-truth poses, which this study needs")
    return stated(run_slam(recording, options, on_progress=on_progress), recording.truth)


def stated(done: SlamRun, truth: tuple[np.ndarray, np.ndarray]) -> Estimates:
    """Return what a run states at every frame, with the times (s) and poses of its truth."""
    n = len(done.frames)
    velocity, covariance = np.full((n, 6), np.nan), np.full((n, 12, 12), np.nan)
    for i, frame in enumerate(done.frames):
        if frame.covariance is not None and frame.velocity is not None:
            velocity[i], covariance[i] = frame.velocity, frame.covariance
    return Estimates(done.times, done.poses, velocity, covariance, ~done.lost, truth)


def parts(recording: Sequence, seconds: float) -> list[Sequence]:
    """Return the consecutive parts of a recording of a length in s; no two share a frame."""
    return [replace(recording, frames=recording.frames[frames]) for frames in segments(recording.times, seconds)]


def errors_of(given: Estimates, delay: float = 0.0, first_pose: Float[np.ndarray, "4 4"] | None = None) -> FilterErrors:
    """Compute the errors of tracked frames with a ground-truth pose, after alignment of the first such frame.

    Args:
        given: estimates and truth.
        delay: of the truth's clock against the images', s: the true pose of a frame is that at its stamp + ``delay``.
        first_pose: the true first pose in the frame of the recorded one; None: the recorded one is right.

    Raises:
        InputError: no two consecutive tracked frames with a ground-truth pose.
    """
    known, start, T_true = aligned_truth(given, delay, first_pose)
    kept = known[(known > start) & given.accepted[known] & np.isfinite(given.covariance[known, 0, 0])]
    # The filter's velocity at a frame is that since the frame before, whose pose must be known too.
    moved = kept[np.isin(kept - 1, known)]
    if not len(moved):
        expected = "two in a row that are tracked, with ground-truth poses"
        raise InputError("study", "frames", expected)
    off = given.velocity[moved] - velocities(given.times, T_true)[moved - 1]
    std = np.sqrt(np.einsum("nii->ni", given.covariance[moved][:, VELOCITY, VELOCITY]))
    return FilterErrors(
        residuals=pose_residuals(given.T_world_cam[kept], T_true[kept]),
        covariances=given.covariance[kept][:, POSE, POSE],
        frames=len(given.times) - 1,
        lost=int(np.count_nonzero(~given.accepted[1:])),
        ended=bool(kept[-1] == known[-1]),
        velocity=off / std,
    )


def aligned_truth(
    given: Estimates, delay: float = 0.0, first_pose: Float[np.ndarray, "4 4"] | None = None
) -> tuple[np.ndarray, int, Float[np.ndarray, "n 4 4"]]:
    """Return frames with ground truth, the first tracked one of them, and all true poses in the estimate's world."""
    times, poses = given.truth
    known = np.unique(trajectory_error.associate(given.times, times)[0])  # the same for every delay
    tracked = known[given.accepted[known]]
    if not len(tracked):
        raise InputError("study", "frames", "one that is tracked, with a ground-truth pose")
    start = int(tracked[0])
    origin = times[0]  # stamps since 1970 leave no digits for a small change of the delay
    T_true = interpolate(times - origin, poses, given.times - origin + delay)
    T_first = T_true[start] if first_pose is None else T_true[start] @ first_pose
    return known, start, given.T_world_cam[start] @ inverse(T_first) @ T_true


def measure(
    recording: Sequence, options: SlamOptions, segments_of: list[Sequence], on_progress: OnProgress | None = None
) -> RunErrors:
    """Run the filter over a recording, and anew over each of its segments."""
    whole = errors_of(estimate(recording, options, on_progress))
    return RunErrors(whole, tuple(last_nees(estimate(part, options, on_progress)) for part in segments_of))


def last_nees(given: Estimates, delay: float = 0.0) -> float | None:
    """Return the NEES at the end of a segment; None where the filter was lost there, or never tracked."""
    try:
        return errors_of(given, delay).last_nees
    except InputError:
        return None
