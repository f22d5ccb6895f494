"""Run SLAM on a recorded sequence: thin the frames, read them ahead, track and map, and record each frame's outcome."""

import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.sequences import FrameReader, Sequence
from vssm_gym.data.trajectories import from_tum
from vssm_gym.errors import InputError, one_of
from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.prism.config import HAND, PrismConfig
from vssm_gym.inference.prism.filter import Prism
from vssm_gym.inference.prism.imu_control import ImuControl
from vssm_gym.inference.smoothing.online import OnlineConfig, OnlineSmoother
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.localise import readable
from vssm_gym.inference.tracking.map_tracker import MapTracker
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.inference.tracking.solvers import SOLVERS
from vssm_gym.maps.voxel_map import TRUNCATION, VoxelMap, read_metadata
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RIGID, GaussianBelief, RigidState, Transition
from vssm_gym.model.transition.with_rest import RestState
from vssm_gym.progress import OnProgress
from vssm_gym.slam.learned_motion import LearnedMotion, check_flight, load_flight_transition

START_STD = 0.3  # m, rad: std of the tracker's given start in a map
START_PATIENCE = 3  # readable frames that may be rejected after the first one before the map is restarted
READ_AHEAD = 4  # images that are read ahead of the filter
MAX_DENSE_CELLS = 30_000_000  # of about 25 bytes; larger cubes are stored block-sparse
MAX_SPARSE_CELLS = 1_000_000_000  # an unobserved cell of a sparse cube takes a tenth of a byte
# Pixels; the rotation search needs to shrink images to 20 pixels.
SMALLEST_IMAGE, LARGEST_IMAGE = (40, 30), (1280, 960)


@dataclass(frozen=True)
class DepthKind:
    """Configure the trust in the depth of one kind of sensor."""

    align: AlignConfig
    truncation: float = TRUNCATION  # voxels behind a surface that an image updates
    reference_limits: tuple[float, float] = (0.15, 0.15)  # m, rad: from a reference view, where a new one is made


_HAND_HELD = TrackingConfig()
DEPTHS = {
    # Structured light, active stereo near by
    "good": DepthKind(_HAND_HELD.align),
    # Noisy stereo at long range (PRISM): a wider truncation band, less weight on geometry, more on colour. Distant
    # surfaces change little when the camera moves half a metre: reference views serve longer, and with fewer of
    # them the camera images taken there drift less.
    "stereo": DepthKind(
        replace(_HAND_HELD.align, geo_sigma=0.02, geo_sigma_quadratic=0.005, rgb_weight=2.0, seen_weight=2.0),
        4.0,
        (0.5, 0.25),
    ),
}
ONLINE = OnlineConfig()
METHODS = ("prism", "smoother", "tracker")
MOVING = 12  # coordinates of pose and velocity; a learned transition has more of its own


@dataclass(frozen=True)
class SlamOptions:
    """Hold the options of ``vssm-gym slam``; an invalid value raises :class:`InputError`."""

    size: tuple[int, int] = (160, 120)  # width, height that images are resized to, pixels
    rate: float = 10.0  # frames a second at most
    voxel: float = 0.07  # m
    extent: float = 14.0  # m: edge of the cube that is mapped, around the first camera
    solver: str = "gauss_newton"  # of the pose, a key of SOLVERS
    samples: int = 1  # odd, of the pose in the map update; from 3 on the map's uncertainty reaches the pose too
    seed: int = 0
    render_width: int = 160  # pixels: images are tracked at about this width
    max_depth: float = MAX_DEPTH  # m; farther readings are left out
    depth: str = "good"  # a key of DEPTHS: what kind of sensor measured it
    imu: bool = False  # whether the sequence's IMU replaces constant velocity in the prior
    transition: Path | None = None  # file of a learned transition that does so, with the IMU's readings
    method: str = "prism"  # one of METHODS: filter, smooth without a filter, or track in ``map``
    map: Path | None = None  # of the tracker: the file of a learned map
    start: tuple[float, ...] | None = None  # of the tracker: about the first camera's pose, x y z qx qy qz qw
    refine: bool = False  # whether the smoother follows the filter
    learn_camera: bool = False  # whether the calibration of a colour camera apart is learned

    def __post_init__(self) -> None:
        if not all(low <= n <= high for low, n, high in zip(SMALLEST_IMAGE, self.size, LARGEST_IMAGE, strict=True)):
            low, high = ("x".join(map(str, size)) for size in (SMALLEST_IMAGE, LARGEST_IMAGE))
            raise InputError("slam", "size", f"width x height between {low} and {high}, not {self.size}")
        if not 0.0 < self.rate < np.inf:
            raise InputError("slam", "rate", f"frames a second, above 0, not {self.rate}")
        if not 0.0 < self.voxel <= 0.5:
            raise InputError("slam", "voxel", f"a cell size in (0, 0.5] m, not {self.voxel}")
        if not 10 * self.voxel <= self.extent < np.inf:
            raise InputError("slam", "extent", f"at least 10 cells of {self.voxel} m, not {self.extent} m")
        if self.cells > MAX_SPARSE_CELLS:
            raise InputError(
                "slam",
                "extent",
                f"at most {MAX_SPARSE_CELLS:,} cells, not {self.cells:,}: a smaller extent or larger voxels",
            )
        if self.method == "smoother" and (self.solver != "gauss_newton" or self.samples != 1):
            name = "samples" if self.samples != 1 else "solver"
            raise InputError("slam", name, "the default with method smoother: it is an option of prism and tracker")
        if self.solver not in SOLVERS:
            raise InputError("slam", "solver", one_of(SOLVERS, self.solver))
        if self.method not in METHODS:
            raise InputError("slam", "method", one_of(METHODS, self.method))
        if self.refine and self.method != "prism":
            whys = {
                "tracker": "the map is given, and poses do not change it",
                "smoother": "all poses are smoothed at the end in any case",
            }
            raise InputError("slam", "refine", f"False with method {self.method}: {whys[self.method]}")
        if self.learn_camera and self.method != "prism":
            raise InputError("slam", "learn-camera", f"False with method {self.method}: prism runs again and again")
        if (self.method == "tracker") != (self.map is not None):
            raise InputError("slam", "map", "a map file with method tracker, and none with another method")
        if self.map is not None:
            read_metadata(self.map)  # report an invalid map file before the sequence is read
        if self.imu and self.method == "tracker":
            expected = "False with method tracker: gravity is known in the first camera's frame, not in the map's"
            raise InputError("slam", "imu", expected)
        if self.transition is not None:
            if self.imu or self.method != "prism" or self.refine:
                expected = "none with imu, with refine or with another method: it is a prior of prism alone"
                raise InputError("slam", "transition", expected)
            load_flight_transition(self.transition)  # report an unsuitable file before the sequence is read
        if self.start is not None and self.method != "tracker":
            raise InputError("slam", "start", "a pose in a map, with method tracker: a new map begins at the camera")
        if self.start is not None and not (
            len(self.start) == 7 and np.isfinite(self.start).all() and 0.9 < np.linalg.norm(self.start[3:]) < 1.1
        ):
            raise InputError("slam", "start", f"x,y,z,qx,qy,qz,qw with a unit quaternion, not {self.start}")
        if not 1 <= self.samples <= 15 or self.samples % 2 == 0:
            raise InputError("slam", "samples", f"an odd number between 1 and 15, not {self.samples}")
        if not 0.5 <= self.max_depth <= 100.0:
            raise InputError("slam", "max-depth", f"metres between 0.5 and 100, not {self.max_depth}")
        if self.depth not in DEPTHS:
            raise InputError("slam", "depth", one_of(DEPTHS, self.depth))
        if not 0 <= self.seed < 2**32:
            raise InputError("slam", "seed", f"between 0 and 2^32 - 1, not {self.seed}")
        if not SMALLEST_IMAGE[0] <= self.render_width <= LARGEST_IMAGE[0]:
            raise InputError(
                "slam",
                "render-width",
                f"between {SMALLEST_IMAGE[0]} and {LARGEST_IMAGE[0]} pixels, not {self.render_width}",
            )

    @property
    def cells(self) -> int:
        """Return the number of cells of the mapped cube."""
        return round(self.extent / self.voxel) ** 3

    @property
    def T_level_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Return the rotation of the world to z up, as in maps of ``map build``.

        None where only a camera defines the world.
        """
        return np.eye(4) if self.map is not None and "belief" not in read_metadata(self.map) else None

    @property
    def tracking(self) -> TrackingConfig:
        """Return the configuration of tracking."""
        return TrackingConfig(align=DEPTHS[self.depth].align, solver=self.solver)

    @property
    def update(self) -> MapUpdateConfig:
        """Return the configuration of the map's update."""
        return MapUpdateConfig(max_depth=self.max_depth, truncation=DEPTHS[self.depth].truncation)

    def filter(self, camera: Camera, transition: Transition = HAND) -> Prism | OnlineSmoother | MapTracker:
        """Return the filter of the method for images of a hand-held camera.

        Args:
            camera: of the images, at :attr:`size`.
            transition: how the camera moves, in its first frame.

        Returns:
            PRISM, the smoother that needs no filter, or the tracker in :attr:`map`.
        """
        if self.method == "tracker":
            return MapTracker(
                Rig.of(camera), transition, self.tracking, RecoveryConfig(), self.max_depth, self.render_width
            )
        if self.method == "smoother":
            smoothing = replace(ONLINE.smoothing, align=self.tracking.align)
            config = replace(
                ONLINE,
                smoothing=smoothing,
                tracking=self.tracking,
                update=self.update,
                track_width=self.render_width,
            )
            return OnlineSmoother(Rig.of(camera), transition, config)
        return self.prism(camera, transition)

    def prism(self, camera: Camera, transition: Transition = HAND) -> Prism:
        """Return PRISM for images of a hand-held camera.

        Args:
            camera: of the images, at :attr:`size`.
            transition: how the camera moves, in its first frame.

        Returns:
            PRISM with the options' sensor, size and solver.
        """
        kind = DEPTHS[self.depth]
        config = PrismConfig(
            tracking=self.tracking,
            update=self.update,
            samples=self.samples,
            track_width=self.render_width,
            reference_distance=kind.reference_limits[0],
            reference_angle=kind.reference_limits[1],
        )
        return Prism(Rig.of(camera), transition, config)

    def prior(self) -> Posterior:
        """Return the belief before the first image: its camera is the world's origin, or near ``start`` in the map."""
        velocity = self.tracking.start_velocity
        if self.map is not None:
            T = np.eye(4) if self.start is None else from_tum(np.array(self.start))
            return Posterior(
                at_rest(RIGID, jnp.asarray(T), START_STD**2 * jnp.eye(6), velocity), VoxelMap.load(self.map)
            )
        cube = VoxelMap.cube if self.cells <= MAX_DENSE_CELLS else VoxelMap.sparse_cube
        known = at_rest(RIGID, jnp.eye(4), 1e-8 * jnp.eye(6), velocity)
        return Posterior(known, cube((0.0, 0.0, 0.0), self.extent, self.voxel))


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
