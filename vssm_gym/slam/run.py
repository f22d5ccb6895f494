"""Run SLAM on a recorded sequence: thin the frames, read them ahead, track and map, and record each frame's outcome."""

import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.sequences import FrameReader, Sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.prism.imu_control import ImuControl
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.localise import readable
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import GaussianBelief, RigidState
from vssm_gym.model.transition.with_rest import RestState
from vssm_gym.progress import OnProgress
from vssm_gym.slam.learned_motion import LearnedMotion, check_flight, load_flight_transition
from vssm_gym.slam.options import SlamOptions

START_PATIENCE = 3  # readable frames that may be rejected after the first one before the map is restarted
READ_AHEAD = 4  # images that are read ahead of the filter
MOVING = 12  # coordinates of pose and velocity; a learned transition has more of its own


@dataclass(frozen=True)
class TrackedFrame:
    """Hold the outcome of one frame. The fit is None where nothing was aligned: before and at the map's first frame."""

    index: int  # in the sequence
    time: float  # s, of its colour image
    T_world_cam: Float[np.ndarray, "4 4"]  # float64; the world is the first camera's frame, or the tracker's map's
    status: Status
    inlier_share: float | None
    coverage: float | None
    photometric: float | None
    in_grid: float  # share of its depth readings that lie in the grid; 1 where it has none
    read_s: float  # reading, undistorting, resizing: in a thread beside the filter
    wait_s: float  # idle time of the filter until the image was there
    step_s: float  # from the image to the pose and the updated map
    stages: dict[str, float]  # s, of the stages that ran: track, recover, map, reference
    warm: bool  # whether every stage that ran had been compiled before
    velocity: Float[np.ndarray, "6"] | None  # linear (m/s) and angular (rad/s), world
    covariance: Float[np.ndarray, "12 12"] | None  # of (translation, rotation) in the camera's tangent and velocity
    left_window: int  # observed blocks dropped from the map because the camera left its window

    @property
    def lost(self) -> bool:
        """Return True if the frame was not accepted, so that the map does not contain it."""
        return not self.status.accepted


@dataclass(frozen=True)
class SlamRun:
    """Hold the outcome of a run."""

    frames: tuple[TrackedFrame, ...]
    posterior: Posterior  # after the last frame
    reader: FrameReader  # of the frames as the filter saw them
    notices: tuple[str, ...]  # problems of the input and how they were handled
    T_level_world: Float[np.ndarray, "4 4"] | None  # the world turned so that z is up; None: unknown

    @property
    def map(self) -> VoxelMap:
        """Return mean and precision of the cells."""
        assert self.posterior.map is not None
        return self.posterior.map

    @property
    def times(self) -> Float[np.ndarray, "frames"]:
        """Return the stamps, s."""
        return np.array([frame.time for frame in self.frames])

    @property
    def poses(self) -> Float[np.ndarray, "frames 4 4"]:
        """Return estimated T_world_cam, including the guesses of lost frames."""
        return np.stack([frame.T_world_cam for frame in self.frames])

    @property
    def lost(self) -> np.ndarray:
        """Return which frames are lost, ``(frames,)`` bool."""
        return np.array([frame.lost for frame in self.frames])


def thin(times: Float[np.ndarray, "n"], rate: float) -> list[int]:
    """Thin a stream of frames to ``rate`` a second: at most ``w rate + 1.5`` frames in any ``w`` seconds.

    A frame may be early by half a period without changing when the next one is due: a camera that runs at ``rate``
    keeps all frames for any jitter.

    Args:
        times: sorted stamps, s.
        rate: frames a second.
    """
    period, due, kept = 1.0 / rate, -np.inf, []
    for index, stamp in enumerate(times):
        if stamp >= due - 0.5 * period:
            kept.append(index)
            due = max(float(stamp), due) + period
    return kept


def prefetch(reader: FrameReader, indices: list[int]) -> Generator[tuple[np.ndarray, np.ndarray, float], None, None]:
    """Yield RGB, depth and the seconds they took to read, in order, read a few frames ahead."""

    def read(index: int) -> tuple[np.ndarray, np.ndarray, float]:
        start = time.perf_counter()
        rgb, depth = reader[index]
        return rgb, depth, time.perf_counter() - start

    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frame-reader")
    try:
        waiting = deque(pool.submit(read, index) for index in indices[:READ_AHEAD])
        for position in range(len(indices)):
            frame = waiting.popleft().result()
            if position + READ_AHEAD < len(indices):
                waiting.append(pool.submit(read, indices[position + READ_AHEAD]))
            yield frame
    finally:
        pool.shutdown(cancel_futures=True)


def run_slam(
    sequence: Sequence,
    options: SlamOptions,
    on_frame: Callable[[TrackedFrame], None] | None = None,
    on_progress: OnProgress | None = None,
) -> SlamRun:
    """Track and map a sequence, frame by frame.

    The world is the first camera's frame and the map a cube around it; the tracker's world is that of its map. Frames
    before the first readable one are lost, and so are those before a new start: see ``_Tracker``.

    Args:
        sequence: the recording.
        options: image size, rate, grid.
        on_frame: called with every finished frame.
        on_progress: called with ``("tracking and mapping", frames done, frames)`` after every frame.

    Returns:
        Every frame's pose with its uncertainty, and the posterior after the last one.

    Raises:
        InputError: an image that cannot be read, or no depth reading in the whole sequence.
    """
    reader = FrameReader(sequence, options.size)
    indices = thin(sequence.times, options.rate)
    tracker = _Tracker(options, reader.camera, sequence)
    frames: list[TrackedFrame] = []
    with closing(prefetch(reader, indices)) as images:
        asked = time.perf_counter()
        for index, (rgb, depth, read_s) in zip(indices, images, strict=True):
            wait_s = time.perf_counter() - asked
            started = tracker.start
            frame = tracker.frame(index, sequence.frames[index].time, rgb, depth, read_s, wait_s)
            if tracker.start != started:  # earlier frames belong to a discarded map
                frames = [replace(one, status=Status.LOST) if one.index == started else one for one in frames]
            frames.append(frame)
            if on_frame:
                on_frame(frame)
            if on_progress:
                on_progress("tracking and mapping", len(frames), len(indices))
            asked = time.perf_counter()
    if tracker.state is None:
        share = f"{options.tracking.min_reading:.0%}"
        raise InputError(sequence.root, "depth", f"a frame with readings at {share} of its pixels; none has")
    notices = (*sequence.notices, *reader.notices, *tracker.notices)
    return SlamRun(tuple(frames), tracker.filter.posterior(tracker.state), reader, notices, options.T_level_world)


class _Stages:
    """Measure the duration of each stage of :meth:`Filter.step`, waiting for its outcome."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, stage: str, outcome: Any) -> Any:
        jax.block_until_ready(outcome)
        now = time.perf_counter()
        self.seconds[stage], self._last = now - self._last, now
        return outcome


def _moving(state: Any) -> RigidState:
    """Return pose and velocity of a state, without the rest of a learned transition."""
    return state.body if isinstance(state, RestState) else state


class _Tracker:
    """Keep the filter's state between frames; ``None`` before the first readable frame.

    A map that starts from a bad image (too dark, too little depth, an object in front of the camera) matches no later
    image: if none of ``START_PATIENCE`` readable frames is accepted after the first one, the map is restarted.
    """

    def __init__(self, options: SlamOptions, camera: Camera, sequence: Sequence) -> None:
        self.options, self.camera, self.sequence = options, camera, sequence
        self.filter = options.filter(camera)
        if options.imu and (sequence.T_body_cam is None or not len(sequence.imu)):
            expected = "imu.txt, and T_body_cam in camera.json, for the option imu"
            raise InputError(sequence.root, "imu", expected)
        self._learned = None if options.transition is None else load_flight_transition(options.transition)
        if self._learned is not None:
            check_flight(sequence)
        self._motion: LearnedMotion | None = None
        self._imu: ImuControl | None = None
        self.state: Any = None
        self.notices: list[str] = []
        self.stamp = 0.0  # s, of the last frame
        self.start = 0  # the frame that the map started from
        self._misses: int | None = (
            0  # frames rejected since then; None: one was accepted, or the map is given and cannot restart
        )
        self._compiled: set[str] = set()  # stages that ran
        v, u = np.mgrid[
            2 : camera.height : 4, 2 : camera.width : 4
        ]  # one pixel of each 4x4, for the share of readings inside the grid
        self._rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T

    def frame(
        self, index: int, stamp: float, rgb: np.ndarray, depth: np.ndarray, read_s: float, wait_s: float
    ) -> TrackedFrame:
        """Localise and map one image."""
        start, stages = time.perf_counter(), _Stages()
        info = None
        status = Status.OK
        image = RGBD.from_camera(rgb, depth)
        if self.state is not None and (self._misses is None or self._misses < START_PATIENCE):
            control, dt = self._control(self.state, stamp), stamp - self.stamp
            self.state, info = self.filter.step(self.state, control, image, dt, clock=stages)
            status = info.status
            if status.accepted:
                self._misses = None
            elif status is Status.LOST and self._misses is not None:
                self._misses += 1
        elif readable(image, self.options.tracking):
            if self.state is not None:
                text = f"frames {self.start} to {index - 1}: none fits the first; the map is restarted at frame {index}"
                self.notices.append(text)
            prior = self.options.prior()
            if self._learned is not None:
                self._motion = LearnedMotion(self._learned, self.sequence, stamp)
                self.filter = self.options.filter(self.camera, self._motion.transition)
                assert isinstance(prior.belief, GaussianBelief)
                prior = replace(prior, belief=self._motion.transition.extend(prior.belief))
            self.state = self.filter.init(prior, image, jax.random.key(self.options.seed))
            self.start, self._misses = index, 0 if self.options.method != "tracker" else None
            status = Status.LOST if self.state.lost else Status.OK
            if self.options.imu:
                assert self.sequence.T_body_cam is not None
                self._imu = ImuControl(self.sequence.imu, self.sequence.T_body_cam, stamp)
        else:
            status = Status.NO_READING
        jax.block_until_ready(self.state)
        step_s = time.perf_counter() - start
        self.stamp = stamp
        warm = info is not None and stages.seconds.keys() <= self._compiled
        self._compiled |= stages.seconds.keys()
        belief = info.belief if info else None
        fit_quality = info.fit_quality if info else None
        T_world_cam = np.eye(4)
        if self.state is not None:
            mean = _moving(belief.mean if belief else self.filter.posterior(self.state).belief.mean)
            T_world_cam = np.asarray(mean.T_world_body, float)
        return TrackedFrame(
            index=index,
            time=stamp,
            T_world_cam=T_world_cam,
            status=status,
            inlier_share=float(fit_quality.inlier_share) if fit_quality else None,
            coverage=float(fit_quality.coverage) if fit_quality else None,
            photometric=float(fit_quality.photometric) if fit_quality else None,
            in_grid=self._in_grid(depth, T_world_cam),
            read_s=read_s,
            wait_s=wait_s,
            step_s=step_s,
            stages=stages.seconds,
            warm=warm,
            velocity=np.asarray(_moving(belief.mean).velocity, float) if belief else None,
            covariance=np.asarray(belief.covariance[:MOVING, :MOVING], float) if belief else None,
            left_window=info.left_window if info else 0,
        )

    def _control(self, state: Any, stamp: float) -> jax.Array:
        """Return the control from the IMU since the last image; zeros (constant velocity) where it is not used."""
        if self._motion is not None:
            return jnp.asarray(self._motion(self.stamp, stamp), jnp.float32)
        if self._imu is None:
            return jnp.zeros(6)
        moving = state.belief.mean
        T_world_cam, velocity = np.asarray(moving.T_world_body), np.asarray(moving.velocity)
        return jnp.asarray(self._imu(T_world_cam, velocity[3:], self.stamp, stamp), jnp.float32)

    def _in_grid(self, depth: np.ndarray, T_world_cam: np.ndarray) -> float:
        if self.state is None:
            return 1.0
        sampled = depth[2::4, 2::4]
        read = (sampled > 0.0) & (sampled <= self.options.max_depth)
        p_world = (self._rays[read] * sampled[read][:, None]) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
        low, high = self.state.map.bounds
        inside = ((p_world >= low) & (p_world <= high)).all(axis=-1)
        return float(inside.mean()) if len(inside) else 1.0
