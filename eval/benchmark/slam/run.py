"""Run a SLAM method on a recording, image by image, and compare its trajectory with the true one."""

import time
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.data.recording import record_handheld, record_wandering
from vssm_gym.data.sequences import FrameReader, Sequence, load_sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.slam import ASTRAY_ERROR, FRAME_RATE
from vssm_gym.eval.benchmark.content import IMAGES_APART, content_of
from vssm_gym.eval.benchmark.entries import find_entry
from vssm_gym.eval.benchmark.suite import Recording, given_seed
from vssm_gym.eval.sweep.supervision import FARTHEST_ESTIMATE, Supervisor, WrongResultError, floats
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.run import thin

WARM = 5  # images at the beginning whose time is not counted: methods compile or allocate


@dataclass(frozen=True)
class SlamUnit:
    """Hold one run: an entry, a recording and the time that the entry may use, s."""

    entry: str  # label
    reference: str
    recording: Recording
    folder: Path  # of the recording
    seconds: float

    @property
    def unit(self) -> str:
        """Return the recording's name."""
        return self.recording.name

    @property
    def cluster(self) -> None:
        """Return None: every recording counts by itself."""


def ensure_recording(recording: Recording, folder: Path, on_progress: OnProgress | None = None) -> Path:
    """Return the folder of a recording inside ``folder``; make it if it is not there."""
    path = folder / recording.name
    if path.is_dir():
        return path
    shared: Any = {"sensor_noise": recording.sensor_noise, "seed": recording.seed, "on_progress": on_progress}
    path.parent.mkdir(parents=True, exist_ok=True)
    if recording.motion == "handheld":
        record_handheld(recording.scene, path, metres=recording.length, rate=FRAME_RATE, **shared)
    else:
        record_wandering(recording.scene, path, seconds=recording.length, noise=recording.noise, **shared)
    return path


def run_recording(unit: SlamUnit) -> dict[str, Any]:
    """Run the entry of a unit on its recording, and return the row."""
    sequence = load_sequence(unit.folder)
    reader, indices = _reader(unit.folder), thin(sequence.times, FRAME_RATE)
    times = sequence.times[indices]
    supervisor, method = Supervisor(unit.seconds), None

    def begin() -> None:
        nonlocal method
        method = find_entry(unit.reference).make()
        method.begin(reader.camera, given_seed(unit.recording.seed))

    supervisor.call(begin)
    poses: list[np.ndarray] = []
    seconds: list[float] = []
    for index, stamp in zip(indices, times - times[0], strict=True):
        rgb, depth = reader[index]
        began = time.perf_counter()
        pose = supervisor.call(partial(_tracked, method, float(stamp), rgb, depth))
        seconds.append(time.perf_counter() - began)
        if pose is None:
            break
        poses.append(pose)
    online, final = np.array(poses), None
    if supervisor.fault is None:
        final = supervisor.call(lambda: _final(method, online))
    assert sequence.truth is not None
    still = _still(sequence, times)
    ate = still if final is None else min(_ate(sequence, times, final), still)
    return {
        "score": ate,
        "success": supervisor.fault is None and ate <= ASTRAY_ERROR,
        "fault": supervisor.fault,
        "p95": float(np.percentile(seconds[WARM:], 95)) if len(seconds) > WARM else None,
        "measured": {} if final is None else {"ate_online": _ate(sequence, times, online), "images": float(len(times))},
        "content": _content(unit.folder),
    }


def standing_still(unit: SlamUnit) -> float:
    """Return the error of a camera that never moves, m: what a failure is worth."""
    sequence = load_sequence(unit.folder)
    return _still(sequence, sequence.times[thin(sequence.times, FRAME_RATE)])


def _still(sequence: Sequence, times: np.ndarray) -> float:
    return _ate(sequence, times, np.tile(np.eye(4), (len(times), 1, 1)))


@lru_cache(maxsize=1)
def _reader(folder: Path) -> FrameReader:
    return FrameReader(load_sequence(folder))


def _tracked(method: Any, stamp: float, rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the pose that a method states of an image."""
    found = method.track(stamp, rgb, depth)
    pose = _pose(found)
    if pose is None:
        raise WrongResultError(f"track was expected to return a rigid pose (4, 4); found {found!r:.80}")
    return pose


@lru_cache(maxsize=1)
def _content(folder: Path) -> str:
    """Return a hash of what a recording holds, at the images that methods are given."""
    reader = _reader(folder)
    chosen = thin(reader.sequence.times, FRAME_RATE)[::IMAGES_APART]
    return content_of(reader.sequence.true_poses(), (reader[index] for index in chosen))


def _final(method: Any, online: np.ndarray) -> np.ndarray:
    """Return the poses that a method knows in the end."""
    found = method.finish()
    if found is None:
        return online
    stated = floats(found)
    poses = [_pose(one) for one in stated] if stated.shape == online.shape else [None]
    if any(pose is None for pose in poses):
        expected = f"finish was expected to return None or rigid poses {online.shape}"
        raise WrongResultError(f"{expected}; found {found!r:.80}")
    return np.array(poses)


def _pose(found: Any) -> Float[np.ndarray, "4 4"] | None:
    """Return a rigid pose as float64; None for anything else, and for one that is too far for a distance."""
    pose = floats(found)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or np.abs(pose).max() > FARTHEST_ESTIMATE:
        return None
    R, last = pose[:3, :3], pose[3]
    rigid = np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0.0
    return pose if rigid and np.allclose(last, [0.0, 0.0, 0.0, 1.0], atol=1e-6) else None


def _ate(sequence: Sequence, times: np.ndarray, poses: np.ndarray) -> float:
    """Return the RMSE of the positions after SE(3) alignment, m.

    A trajectory in one place, or on one line, has no unique alignment: the best one is of the middles alone.
    """
    assert sequence.truth is not None
    of_est, of_true = trajectory_error.associate(times, sequence.truth[0])
    est, true = poses[of_est], sequence.truth[1][of_true]
    try:
        return trajectory_error.Statistics.of(trajectory_error.ate(est, true).translation).rmse
    except InputError:
        off = (est[:, :3, 3] - est[:, :3, 3].mean(axis=0)) - (true[:, :3, 3] - true[:, :3, 3].mean(axis=0))
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
