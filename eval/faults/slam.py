"""Measure what SLAM believes of faulty images: every fault is to be flagged, and no confident pose to be wrong.

    e_k = log(T_est_k^-1 A T_true_k),  A = T_est_r T_true_r^-1,   r the last frame before the fault

The pose of an accepted frame is *confident*. It is wrong where the position or the rotation of ``e_k`` exceeds
``ALLOWED_STDS`` of its own standard deviations, along the error, by more than ``POSE_TOLERANCE``. A fault is flagged by
the first frame that is not accepted, or is accepted as relocalised. A fault of the image must be flagged within
``FLAG_DELAY`` frames. A fault of the motion shows nothing false: it must be flagged only where a pose is wrong.
"""

import tempfile
from collections.abc import Sequence as List
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import FrameReader, Sequence, SequenceWriter, load_sequence
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.faults.injectors import DEPTH_LAG, IMAGE_FAULTS, MOTION_FAULTS, reordered
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.status import Status
from vssm_gym.progress import OnProgress
from vssm_gym.slam.calibration import pose_residuals
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import SlamRun, run_slam

FAULTS = (*IMAGE_FAULTS, *MOTION_FAULTS)
WALK_SCENES = ("birch", "maple")  # of the simulated walks; thresholds were chosen in oak
WALK_LENGTH = 14.0  # m, of a simulated walk
FRAMES_BEFORE, FRAMES_DURING, FRAMES_AFTER = 28, 12, 24  # frames without fault, with it, without it
PLACES_EACH = 2  # of a recording at most, all in its second half: thresholds were chosen on first halves
FLAG_DELAY = 3  # frames within which a fault of the image must be flagged
ALLOWED_STDS, POSE_TOLERANCE = 3.0, (0.05, 0.05)  # m, rad beyond so many standard deviations
FAULT_SIZE = (160, 120)  # pixels of the images
WALK_CAMERA = CameraConfig(*FAULT_SIZE, hfov=1.1)  # about a Kinect's


@dataclass(frozen=True)
class Place:
    """Hold where in a recording the faults happen."""

    name: str
    sequence: Sequence
    first: int  # frame of the recording that the run starts with


@dataclass(frozen=True)
class FaultRow:
    """Hold the outcome of one run."""

    fault: str
    place: str
    flagged: int | None  # frames of the fault before the one that was flagged
    confident: int  # accepted frames since the fault began
    error_m: float  # largest error of a confident position since then
    error_stds: float  # and its standard deviations
    error_rad: float  # largest error of a confident rotation
    wrong: int  # confident poses that are wrong
    back: int | None  # frames after the end of the fault before one was accepted again
    missed: bool

    @property
    def passed(self) -> bool:
        """Return whether the fault was flagged where it had to be, and no confident pose was wrong."""
        return not self.missed and self.wrong == 0


def run(recordings: List[Sequence], *, seed: int = 0, on_progress: OnProgress | None = None) -> list[FaultRow]:
    """Run SLAM with every fault at every place of the simulated walks and of other recordings.

    Args:
        recordings: further ones, with ground truth.
        seed: of the walks and of the faults.
        on_progress: called after every run.

    Raises:
        InputError: a recording without ground truth, or too short.
    """
    with tempfile.TemporaryDirectory() as folder:
        walks = []
        for scene in WALK_SCENES:
            walk = Path(folder) / scene
            record_handheld(scene, walk, metres=WALK_LENGTH, sensor_noise="kinect", camera=WALK_CAMERA, seed=seed)
            walks.append(load_sequence(walk))
        places = [place for sequence in (*walks, *recordings) for place in places_of(sequence)]
        rows = []
        for place in places:
            for fault in FAULTS:
                rows.append(measure(fault, place, seed))
                if on_progress:
                    on_progress("SLAM with faults", len(rows), len(FAULTS) * len(places))
    return rows


def places_of(sequence: Sequence) -> list[Place]:
    """Return the places of a recording: stretches one after the other, from its middle on."""
    name, length = sequence.root.resolve().name, FRAMES_BEFORE + FRAMES_DURING + FRAMES_AFTER
    starts = range(len(sequence.frames) // 2, len(sequence.frames) - length + 1, length)
    if not starts:
        raise InputError(sequence.root, "frames", f"at least {2 * length}; found {len(sequence.frames)}")
    return [Place(f"{name}, frame {start}", sequence, start) for start in starts[:PLACES_EACH]]


def measure(fault: str, place: Place, seed: int = 0) -> FaultRow:
    """Run SLAM with one fault at one place."""
    with tempfile.TemporaryDirectory() as folder:
        truth = write_faulty(fault, place, Path(folder) / "faulty", seed)
        slam = run_slam(load_sequence(Path(folder) / "faulty"), SlamOptions(size=FAULT_SIZE, rate=100.0))
    return judged(fault, place.name, slam, truth)


def write_faulty(fault: str, place: Place, out: Path, seed: int) -> Float[np.ndarray, "frames 4 4"]:
    """Write the frames of a place with a fault as a recording; return where the camera truly is at each of them."""
    sequence = place.sequence
    reader, T_world_cam = FrameReader(sequence, FAULT_SIZE), sequence.true_poses()
    order = place.first + np.arange(FRAMES_BEFORE + FRAMES_DURING + FRAMES_AFTER)
    stamps = sequence.times[order]
    if fault in MOTION_FAULTS:
        order = reordered(fault, T_world_cam, order, FRAMES_BEFORE, FRAMES_DURING)
    earlier = range(place.first - DEPTH_LAG, place.first)  # a late depth image may be older than the first frame
    images = [reader[index] for index in (*earlier, *order)]
    rng = np.random.default_rng(seed)
    writer = SequenceWriter(out, reader.camera, np.eye(4), controls=False)
    for k, stamp in enumerate(stamps):
        rgb, depth = images[DEPTH_LAG + k]
        if fault in IMAGE_FAULTS and FRAMES_BEFORE <= k < FRAMES_BEFORE + FRAMES_DURING:
            rgb, depth = IMAGE_FAULTS[fault](images[: DEPTH_LAG + k + 1], DEPTH_LAG + FRAMES_BEFORE, rng)
        writer.append(stamp, rgb, depth, T_world_cam[order[k]])
    writer.close()
    return T_world_cam[order]


def judged(fault: str, place: str, slam: SlamRun, T_true: Float[np.ndarray, "frames 4 4"]) -> FaultRow:
    """Compare the beliefs of a run since its fault with the truth."""
    frames = slam.frames[FRAMES_BEFORE:]
    T_world_truth = slam.poses[FRAMES_BEFORE - 1] @ inverse(T_true[FRAMES_BEFORE - 1])
    errors = pose_residuals(slam.poses[FRAMES_BEFORE:], T_world_truth @ T_true[FRAMES_BEFORE:])
    believed = [(e, f.covariance) for e, f in zip(errors, frames, strict=True) if not f.lost]
    confident = [(e, covariance[:6, :6]) for e, covariance in believed if covariance is not None]
    sizes = np.array([[np.linalg.norm(e[:3]), np.linalg.norm(e[3:])] for e, _ in confident]).reshape(-1, 2)
    stds = np.array([[_along(e[:3], S[:3, :3]), _along(e[3:], S[3:, 3:])] for e, S in confident]).reshape(-1, 2)
    wrong = int(np.sum((sizes > ALLOWED_STDS * stds + POSE_TOLERANCE).any(axis=1)))
    status = [frame.status for frame in frames]
    flagged = next((k for k in range(FRAMES_DURING) if status[k] is not Status.OK), None)
    ends = 0 if fault == "shove" else FRAMES_DURING
    back = next((k for k, frame in enumerate(frames[ends:]) if not frame.lost), None)
    late = flagged is None or flagged >= FLAG_DELAY
    missed = late and (fault in IMAGE_FAULTS or wrong > 0)
    worst = int(np.argmax(sizes[:, 0])) if len(sizes) else None
    return FaultRow(
        fault=fault,
        place=place,
        flagged=flagged,
        confident=len(sizes),
        error_m=0.0 if worst is None else float(sizes[worst, 0]),
        error_stds=0.0 if worst is None else float(sizes[worst, 0] / stds[worst, 0]),
        error_rad=float(sizes[:, 1].max(initial=0.0)),
        wrong=wrong,
        back=back,
        missed=missed,
    )


def _along(e: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]) -> float:
    """``sqrt(e^T S e) / |e|``: the standard deviation along an error; the mean of the axes for no error."""
    size = np.linalg.norm(e)
    return float(np.sqrt(e @ covariance @ e) / size if size > 0.0 else np.sqrt(np.trace(covariance) / len(e)))


def figures(rows: List[FaultRow]) -> dict[str, object]:
    """Return the rows and what they were judged by, for JSON."""
    rule = {
        "delay_frames": FLAG_DELAY,
        "stds": ALLOWED_STDS,
        "tolerance_m": POSE_TOLERANCE[0],
        "tolerance_rad": POSE_TOLERANCE[1],
    }
    return {"rule": rule, "rows": [asdict(row) | {"passed": row.passed} for row in rows]}
