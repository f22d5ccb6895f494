"""Read and write RGB-D sequences as TUM folders, with ``camera.json`` and ``controls.txt`` beside TUM's own files.

``rgb.txt``, ``depth.txt`` (time, file), ``associations.txt`` (both), ``groundtruth.txt`` (T_world_cam), images as JPEG
or PNG, depth as 16-bit PNG, metres = value / depth_scale, 0 = no reading.
"""

import json
import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from vssm_gym.data.distortion import distort
from vssm_gym.data.images import colour_image, depth_image
from vssm_gym.data.index import ASSOCIATION_TOLERANCE, Frame, read_frames
from vssm_gym.data.intrinsics import DEPTH_SCALE, CameraCalibration, ColourCalibration, read_calibration
from vssm_gym.data.registration import Registration
from vssm_gym.data.trajectories import interpolate, read_trajectory, tum_line
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.numbers import read_table
from vssm_gym.files.output_folders import check_new_folder
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import ColourCamera

LARGEST_GAP = 0.5  # s from a frame to the poses before and after it that give its own; TUM's fr1_xyz has 0.11 s
FEWEST_BLOCKS = 4  # of pixels that a colour image is averaged over, across and down
TRIED = 10  # first frames, of which one must be readable


@dataclass(frozen=True)
class Sequence:
    """Describe a recorded sequence: its frames, the camera that took them, and known poses."""

    root: Path
    frames: tuple[Frame, ...]
    camera: Camera  # of the depth images as recorded (before undistortion), and of colour that is registered to them
    distortion: np.ndarray  # (5,) k1 k2 p1 p2 k3
    depth_scale: float  # units a metre
    T_body_cam: np.ndarray | None  # (4, 4)
    truth: tuple[np.ndarray, np.ndarray] | None  # times (n,), T_world_cam (n, 4, 4)
    controls: np.ndarray  # (n, 1 + controls) time and command; empty where none were recorded
    notices: tuple[str, ...] = ()  # what was wrong with the index, a sentence each: for the user
    imu: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))  # (n, 7) time, rate, specific force; as imu.txt
    colour: ColourCalibration | None = None  # of colour images that are not registered to depth

    @property
    def calibration(self) -> CameraCalibration:
        """Return what ``camera.json`` holds."""
        return CameraCalibration(self.camera, self.distortion, self.depth_scale, self.T_body_cam, self.colour)

    @property
    def times(self) -> np.ndarray:
        """Return frame times (frames,), s."""
        return np.array([frame.time for frame in self.frames])

    def true_poses(self) -> np.ndarray:
        """Return ground-truth T_world_cam (frames, 4, 4), interpolated at the frame times.

        Raises:
            InputError: the sequence has no ground truth, or none near enough to one of the frames.
        """
        path = self.root / "groundtruth.txt"
        if self.truth is None:
            raise InputError(path, "file", "ground-truth poses, which this command needs")
        bad = ~self.has_pose()
        if bad.any():
            expected = f"a pose at every frame, or within {LARGEST_GAP} s before and after it"
            raise InputError(path, "times", f"{expected}; the frame at {self.times[bad][0]:.6f} s has none")
        return interpolate(*self.truth, self.times)

    def has_pose(self) -> np.ndarray:
        """Return which frames (frames,) have a ground-truth pose at their time, or near enough before and after it."""
        if self.truth is None:
            return np.zeros(len(self.frames), bool)
        known = np.concatenate([[-np.inf], self.truth[0], [np.inf]])
        following = np.searchsorted(known, self.times)
        before, after = self.times - known[following - 1], known[following] - self.times
        return (np.maximum(before, after) <= LARGEST_GAP) | (np.minimum(before, after) <= ASSOCIATION_TOLERANCE)


class FrameReader:
    """Read frames of a sequence, undistorted and resized to ``width x height``, with the resulting camera.

    Colour is averaged over the source pixels of a target pixel; depth takes the nearest reading, because an average
    across an edge is a surface that does not exist. Where colour is another camera's, each depth pixel takes the colour
    of its point, and one whose colour is unknown counts as without a reading
    (:class:`~vssm_gym.data.registration.Registration`).

    A frame with a damaged image is black and has no depth, so that one bad file does not end a long run. ``notices``
    names each of them.
    """

    def __init__(self, sequence: Sequence, size: tuple[int, int] | None = None) -> None:
        self.sequence = sequence
        self._damage: dict[int, str] = {}
        self._lock = threading.Lock()
        source = sequence.camera
        width, height = size or (source.width, source.height)
        self.camera = source.resized(width, height)
        self._u, self._v = _undistorted(source, self.camera, sequence.distortion)
        # Integer shrinking averages blocks first; the remaining factor is below 2 and bilinear.
        self._block = max(1, min(source.width // width, source.height // height))
        self._registration: Registration | None = None
        self.colour: ColourCamera | None = None  # of :meth:`unregistered`; None where colour is registered
        if (colour := sequence.colour) is not None:
            recorded = colour.view.camera
            self._registration = Registration(self.camera, colour)
            smaller = int(recorded.K[0, 0] / self.camera.K[0, 0])
            self._block = max(1, min(smaller, recorded.width // FEWEST_BLOCKS, recorded.height // FEWEST_BLOCKS))
            across = min(width, recorded.width)
            self._shrunk = recorded.width // across
            self.colour = colour.view.resized(across, max(1, round(recorded.height * across / recorded.width)))
            self._u_colour, self._v_colour = _undistorted(recorded, self.colour.camera, colour.distortion)

    def __len__(self) -> int:
        return len(self.sequence.frames)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return RGB uint8 (height, width, 3) and z-depth float32 (height, width), m; 0 where there is no reading."""
        read = self._read(index)
        if read is None:
            size = (self.camera.height, self.camera.width)
            return np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)
        rgb, depth = read
        if self._registration is None:
            return _sampled(rgb, self._u, self._v, self._block), depth
        u, v, known = self._registration(depth)
        return _sampled(rgb, u, v, self._block), np.where(known, depth, np.float32(0.0))

    def unregistered(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return RGB as the colour camera :attr:`colour` sees it, and all readings of the depth camera."""
        assert self.colour is not None
        read, camera = self._read(index), self.colour.camera
        if read is None:
            empty = np.zeros((self.camera.height, self.camera.width), np.float32)
            return np.zeros((camera.height, camera.width, 3), np.uint8), empty
        return _sampled(read[0], self._u_colour, self._v_colour, self._shrunk), read[1]

    def _read(self, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return colour as stored and depth at the reader's size, m; None where one of them is damaged."""
        frame, camera, colour = self.sequence.frames[index], self.sequence.camera, self.sequence.colour
        of_colour = camera if colour is None else colour.view.camera
        try:
            rgb = colour_image(frame.rgb, (of_colour.width, of_colour.height))
            depth = depth_image(frame.depth, (camera.width, camera.height))
        except InputError as damage:
            self._note(index, f"{damage}; the frame at {frame.time:.6f} s counts as empty")
            return None
        metres = depth.astype(np.float32) / np.float32(self.sequence.depth_scale)
        return rgb, self._nearest(np.where(np.isfinite(metres) & (metres > 0.0), metres, np.float32(0.0)))

    @property
    def notices(self) -> tuple[str, ...]:
        """Return a sentence for each damaged frame read so far, in the sequence's order."""
        with self._lock:
            return tuple(self._damage[index] for index in sorted(self._damage))

    def _note(self, index: int, sentence: str) -> None:
        with self._lock:  # frames are read ahead by a thread
            self._damage[index] = sentence

    def _nearest(self, image: np.ndarray) -> np.ndarray:
        u, v = np.rint(self._u).astype(int), np.rint(self._v).astype(int)
        inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
        return np.where(inside, image[np.where(inside, v, 0), np.where(inside, u, 0)], 0).astype(image.dtype)


def _undistorted(source: Camera, target: Camera, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return column and row in a recorded image of each pixel of the undistorted and resized one."""
    v, u = np.mgrid[0 : target.height, 0 : target.width]
    x, y = distort((u - target.cx) / target.fx, (v - target.cy) / target.fy, distortion)
    return x * source.fx + source.cx, y * source.fy + source.cy


def _sampled(rgb: np.ndarray, u: np.ndarray, v: np.ndarray, block: int) -> np.ndarray:
    """Return colours at columns and rows of an image, bilinear between means of blocks."""
    n = block if block > 2 else 1  # bilinear alone already averages 2x2
    h, w = rgb.shape[0] // n * n, rgb.shape[1] // n * n
    image = rgb[:h, :w].reshape(h // n, n, w // n, n, 3).mean(axis=(1, 3), dtype=np.float32)
    u = np.clip((u + 0.5) / n - 0.5, 0, image.shape[1] - 1.001)
    v = np.clip((v + 0.5) / n - 0.5, 0, image.shape[0] - 1.001)
    i, j = v.astype(int), u.astype(int)
    a, b = (v - i)[..., None], (u - j)[..., None]
    top = image[i, j] * (1 - b) + image[i, j + 1] * b
    bottom = image[i + 1, j] * (1 - b) + image[i + 1, j + 1] * b
    return np.rint(top * (1 - a) + bottom * a).astype(np.uint8)


def load_sequence(root: str | Path, intrinsics: tuple[float, ...] | None = None) -> Sequence:
    """Read the index files of a TUM folder; images are read later, by :class:`FrameReader`.

    Args:
        root: The folder.
        intrinsics: ``fx fy cx cy [k1 k2 p1 p2 k3]`` of the recorded images, in place of the folder's ``camera.json``.

    Returns:
        The frames by file name, the camera, and what else was recorded: true poses, controls, IMU readings.

    Raises:
        InputError: an index file is missing or malformed, none of the first frames can be read, depth and colour
            differ in size and are not two cameras, or the intrinsics are of another size.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(root, "folder", "an existing sequence folder (TUM layout)")
    frames, notices = read_frames(root)
    of_colour, of_depth, first = _sizes(frames)
    known = read_calibration(root, *of_depth, intrinsics, of_colour, first)
    truth_path = root / "groundtruth.txt"
    truth = read_trajectory(truth_path) if truth_path.is_file() else None
    controls_path = root / "controls.txt"
    controls = np.zeros((0, 1))
    if controls_path.is_file():
        controls = read_table(controls_path, "time and command")
    return Sequence(
        root,
        frames,
        known.camera,
        known.distortion,
        known.depth_scale,
        known.T_body_cam,
        truth,
        controls,
        notices,
        _imu(root / "imu.txt"),
        known.colour,
    )


def _imu(path: Path) -> np.ndarray:
    """Read IMU readings ``(n, 7)``; none where the file is missing."""
    if not path.is_file():
        return np.zeros((0, 7))
    expected = "time wx wy wz fx fy fz: finite numbers, times ascending"
    readings = read_table(path, expected, columns=7)
    if (np.diff(readings[:, 0]) <= 0.0).any():
        raise InputError(path, "lines", expected)
    return readings


def imu_line(time: float, reading: np.ndarray) -> str:
    """Format a line of ``imu.txt``: stamp (s), angular rate (rad/s) and specific force (m/s^2) in the body's frame."""
    return f"{time:.6f} " + " ".join(f"{value:.7g}" for value in reading) + "\n"


def _sizes(frames: tuple[Frame, ...]) -> tuple[tuple[int, int], tuple[int, int], Frame]:
    """Return width and height of colour and of depth, and the frame that they are found in: the first readable one."""
    first: InputError | None = None
    for frame in frames[:TRIED]:
        try:
            rgb = colour_image(frame.rgb, None)
            depth = depth_image(frame.depth, None)
        except InputError as error:
            first = first or error
            continue
        return (rgb.shape[1], rgb.shape[0]), (depth.shape[1], depth.shape[0]), frame
    assert first is not None
    raise first


class SequenceWriter:
    """Write a sequence frame by frame; ``close`` adds ``camera.json``, which marks a complete recording."""

    def __init__(
        self,
        root: str | Path,
        camera: Camera,
        T_body_cam: np.ndarray,
        controls: bool = True,
        depth_scale: float = DEPTH_SCALE,
        colour: ColourCalibration | None = None,
    ) -> None:
        """Create the folder and its index files.

        Args:
            root: new or empty folder.
            camera: of the depth images, and of colour that is registered to them.
            T_body_cam: (4, 4) pose of the depth camera on the body.
            controls: whether commands are recorded; otherwise there is no ``controls.txt``.
            depth_scale: units a metre; readings beyond 65535 units do not fit 16 bits and are stored as 0.
            colour: stated calibration of colour images that are not registered; truth is no part of a recording.
        """
        self.root = Path(root)
        check_new_folder(self.root)
        for name in ("rgb", "depth"):
            (self.root / name).mkdir(parents=True, exist_ok=True)
        self.camera, self.T_body_cam = camera, np.asarray(T_body_cam, dtype=float)
        self.depth_scale = depth_scale
        self.colour = colour
        names = ["rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt"] + ["controls.txt"] * controls
        self._files = {name: (self.root / name).open("w") for name in names}
        self._files["groundtruth.txt"].write("# timestamp tx ty tz qx qy qz qw\n")

    def append(
        self,
        time: float,
        rgb: np.ndarray,
        depth: np.ndarray,
        T_world_cam: np.ndarray,
        control: np.ndarray | None = None,
    ) -> None:
        """Add one frame and the command that led to it.

        Args:
            time: Seconds.
            rgb: (height, width, 3) uint8.
            depth: (height, width) z-depth, m.
            T_world_cam: (4, 4) true pose of the depth camera.
            control: the command since the frame before, where the writer has controls.
        """
        units = np.rint(np.asarray(depth, dtype=np.float64) * self.depth_scale)
        units[(units > np.iinfo(np.uint16).max) | ~np.isfinite(units)] = 0
        colour_name, depth_name = f"rgb/{time:.6f}.png", f"depth/{time:.6f}.png"
        Image.fromarray(rgb).save(self.root / colour_name, compress_level=1)
        Image.fromarray(units.astype(np.uint16)).save(self.root / depth_name, compress_level=1)
        self._files["rgb.txt"].write(f"{time:.6f} {colour_name}\n")
        self._files["depth.txt"].write(f"{time:.6f} {depth_name}\n")
        self._files["associations.txt"].write(f"{time:.6f} {colour_name} {time:.6f} {depth_name}\n")
        self._files["groundtruth.txt"].write(tum_line(time, T_world_cam))
        if control is not None:
            self._files["controls.txt"].write(f"{time:.6f} " + " ".join(f"{value:.7g}" for value in control) + "\n")

    @property
    def calibration(self) -> CameraCalibration:
        """Return what ``camera.json`` will hold."""
        return CameraCalibration(self.camera, np.zeros(5), self.depth_scale, self.T_body_cam, self.colour)

    def close(self) -> None:
        """Finish the index files and write ``camera.json``."""
        for file in self._files.values():
            file.close()
        stored = self.calibration.as_json()
        with atomic_write(self.root / "camera.json") as temporary:
            temporary.write_text(json.dumps(stored, indent=1))
