"""Recorded RGB-D sequences as TUM folders, with ``camera.json`` and ``controls.txt`` beside TUM's own files (DESIGN).

``rgb.txt``, ``depth.txt`` (time, file), ``associations.txt`` (both), ``groundtruth.txt`` (T_world_cam), images as JPEG
or PNG, depth as 16-bit PNG, metres = value / depth_scale, 0 = no reading.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from vssm_gym.camera import Camera
from vssm_gym.data.trajectories import interpolate, numbered_lines, read_trajectory, tum_line
from vssm_gym.errors import InputError
from vssm_gym.files import atomic_write

DEPTH_SCALE = 5000.0  # TUM's: one unit is 0.2 mm
ASSOCIATION_TOLERANCE = 0.02  # s between a colour and a depth image of one frame, or between a frame and its pose
LARGEST_GAP = 0.5  # s from a frame to the poses before and after it that give its own; TUM's fr1_xyz has 0.11 s

# Published intrinsics of the TUM RGB-D cameras at 640x480: fx fy cx cy, k1 k2 p1 p2 k3; by a word of the folder's name.
TUM_CAMERAS = {
    ("fr1", "freiburg1"): ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    ("fr2", "freiburg2"): ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    ("fr3", "freiburg3"): ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


@dataclass(frozen=True)
class Frame:
    """One RGB-D frame on disk, stamped with its colour image's time (s)."""

    time: float
    rgb: Path
    depth: Path


@dataclass(frozen=True)
class Sequence:
    """A recorded sequence: where the frames are, the camera that took them, and what is known of their poses."""

    root: Path
    frames: tuple[Frame, ...]
    camera: Camera  # of the images as recorded (before undistortion)
    distortion: np.ndarray  # (5,) k1 k2 p1 p2 k3
    depth_scale: float  # units a metre
    T_body_cam: np.ndarray | None  # (4, 4)
    truth: tuple[np.ndarray, np.ndarray] | None  # times (n,), T_world_cam (n, 4, 4)
    controls: np.ndarray  # (n, 1 + controls) time and command; empty where none were recorded

    @property
    def times(self) -> np.ndarray:
        """Frame times (frames,), s."""
        return np.array([frame.time for frame in self.frames])

    def true_poses(self) -> np.ndarray:
        """Ground-truth T_world_cam (frames, 4, 4), interpolated at the frame times.

        Raises:
            InputError: the sequence has no ground truth, or none near enough to one of the frames.
        """
        path = self.root / "groundtruth.txt"
        if self.truth is None:
            raise InputError(path, "file", "ground-truth poses, which this command needs")
        known = np.concatenate([[-np.inf], self.truth[0], [np.inf]])
        following = np.searchsorted(known, self.times)
        before, after = self.times - known[following - 1], known[following] - self.times
        bad = (np.maximum(before, after) > LARGEST_GAP) & (np.minimum(before, after) > ASSOCIATION_TOLERANCE)
        if bad.any():
            expected = f"a pose at every frame, or within {LARGEST_GAP} s before and after it"
            raise InputError(path, "times", f"{expected}; the frame at {self.times[bad][0]:.6f} s has none")
        return interpolate(*self.truth, self.times)


class FrameReader:
    """Frames of a sequence, undistorted and resized to ``width x height``, with the camera that then took them.

    Colour is averaged over the source pixels of a target pixel; depth takes the nearest reading, because an average
    across an edge is a surface that does not exist.
    """

    def __init__(self, sequence: Sequence, size: tuple[int, int] | None = None) -> None:
        self.sequence = sequence
        source = sequence.camera
        width, height = size or (source.width, source.height)
        self.camera = source.resized(width, height)
        # Whole-number shrinking is done by averaging blocks first; what remains is below 2 and bilinear.
        self._block = max(1, min(source.width // width, source.height // height))
        v, u = np.mgrid[0:height, 0:width]
        x, y = (u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy
        x, y = distort(x, y, sequence.distortion)
        self._u, self._v = x * source.fx + source.cx, y * source.fy + source.cy

    def __len__(self) -> int:
        return len(self.sequence.frames)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """RGB uint8 (height, width, 3) and z-depth float32 (height, width), m."""
        frame = self.sequence.frames[index]
        rgb, depth = read_image(frame.rgb), read_image(frame.depth)
        expected = (self.sequence.camera.height, self.sequence.camera.width)
        for path, image in ((frame.rgb, rgb), (frame.depth, depth)):
            if image.shape[:2] != expected:
                raise InputError(path, "size", f"{expected[1]}x{expected[0]} pixels as the camera says")
        if depth.ndim != 2 or depth.dtype.kind not in "uif":
            raise InputError(frame.depth, "pixels", "one 16-bit channel of depth")
        if rgb.dtype != np.uint8:
            raise InputError(frame.rgb, "pixels", "8 bits a colour channel")
        if rgb.ndim == 2 or rgb.shape[2] < 3:  # grey, maybe with transparency
            rgb = np.repeat(rgb.reshape(*expected, -1)[..., :1], 3, axis=2)
        metres = depth.astype(np.float32) / np.float32(self.sequence.depth_scale)
        return self._colour(rgb[..., :3]), self._nearest(metres)

    def _nearest(self, image: np.ndarray) -> np.ndarray:
        u, v = np.rint(self._u).astype(int), np.rint(self._v).astype(int)
        inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
        return np.where(inside, image[np.where(inside, v, 0), np.where(inside, u, 0)], 0).astype(image.dtype)

    def _colour(self, rgb: np.ndarray) -> np.ndarray:
        n = self._block if self._block > 2 else 1  # bilinear alone already averages 2x2
        h, w = rgb.shape[0] // n * n, rgb.shape[1] // n * n
        image = rgb[:h, :w].reshape(h // n, n, w // n, n, 3).mean(axis=(1, 3), dtype=np.float32)
        u = np.clip((self._u + 0.5) / n - 0.5, 0, image.shape[1] - 1.001)
        v = np.clip((self._v + 0.5) / n - 0.5, 0, image.shape[0] - 1.001)
        i, j = v.astype(int), u.astype(int)
        a, b = (v - i)[..., None], (u - j)[..., None]
        top = image[i, j] * (1 - b) + image[i, j + 1] * b
        bottom = image[i + 1, j] * (1 - b) + image[i + 1, j + 1] * b
        return np.rint(top * (1 - a) + bottom * a).astype(np.uint8)


def distort(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brown-Conrady: undistorted to distorted normalised coordinates; ``k`` = (k1, k2, p1, p2, k3)."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def read_image(path: Path) -> np.ndarray:
    """The pixels of an image file, as stored."""
    if not path.is_file():
        raise InputError(path, "file", "an existing image, as the sequence's index lists it")
    try:
        return iio.imread(path, plugin="pillow")
    except (OSError, ValueError, SyntaxError) as error:  # Pillow calls a broken PNG chunk a syntax error
        raise InputError(path, "pixels", f"a readable image ({error})") from error


def load_sequence(root: str | Path, intrinsics: tuple[float, ...] | None = None) -> Sequence:
    """Read the index files of a TUM folder; images are read later, by :class:`FrameReader`.

    Args:
        root: The folder.
        intrinsics: ``fx fy cx cy [k1 k2 p1 p2 k3]`` of the recorded images, in place of the folder's ``camera.json``.

    Raises:
        InputError: an index file is missing or malformed, or lists an image that does not exist.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(root, "folder", "an existing sequence folder (TUM layout)")
    frames = _frames(root)
    camera, distortion, depth_scale, T_body_cam = _camera(root, frames, intrinsics)
    truth_path = root / "groundtruth.txt"
    truth = read_trajectory(truth_path) if truth_path.is_file() else None
    controls_path = root / "controls.txt"
    controls = np.zeros((0, 1))
    if controls_path.is_file():
        try:
            controls = np.loadtxt(controls_path, ndmin=2)
        except ValueError as error:
            raise InputError(controls_path, "lines", f"time and command, numbers only ({error})") from error
    return Sequence(root, frames, camera, distortion, depth_scale, T_body_cam, truth, controls)


def _rows(path: Path, columns: int) -> list[tuple[float, list[str]]]:
    """The lines of an index file: the time that opens each (s), and all its words."""
    if not path.is_file():
        raise InputError(path, "file", "this index file of the sequence")
    rows = []
    for number, line in numbered_lines(path):
        words = line.split()
        try:
            time = float(words[0])
        except ValueError:
            time = math.nan
        if len(words) < columns or not math.isfinite(time):
            raise InputError(path, f"line {number}", f"{columns} columns, a time in seconds first, then a file")
        rows.append((time, words))
    if not rows:
        raise InputError(path, "file", "at least one image")
    return rows


def _frames(root: Path) -> tuple[Frame, ...]:
    pairs = root / "associations.txt"
    if pairs.is_file():
        frames = [Frame(time, root / words[1], root / words[3]) for time, words in _rows(pairs, 4)]
        return _existing(frames, pairs, pairs)
    rgb_index, depth_index = root / "rgb.txt", root / "depth.txt"
    colour, depth = _rows(rgb_index, 2), _rows(depth_index, 2)
    depth_times = np.array([time for time, _ in depth])
    frames = []
    for time, words in colour:
        nearest = int(np.argmin(np.abs(depth_times - time)))
        if abs(depth_times[nearest] - time) <= ASSOCIATION_TOLERANCE:
            frames.append(Frame(time, root / words[1], root / depth[nearest][1][1]))
    if not frames:
        raise InputError(root, "rgb.txt, depth.txt", f"images within {ASSOCIATION_TOLERANCE} s of each other")
    return _existing(frames, rgb_index, depth_index)


def _existing(frames: list[Frame], rgb_index: Path, depth_index: Path) -> tuple[Frame, ...]:
    """The frames by time, all their images there: a hole is better found now than after an hour of mapping."""
    for frame in frames:
        for image, index in ((frame.rgb, rgb_index), (frame.depth, depth_index)):
            if not image.is_file():
                raise InputError(index, "images", f"existing files only; {image} is missing")
    return tuple(sorted(frames, key=lambda frame: frame.time))


def _camera(
    root: Path, frames: tuple[Frame, ...], intrinsics: tuple[float, ...] | None
) -> tuple[Camera, np.ndarray, float, np.ndarray | None]:
    """Camera, distortion, depth scale and T_body_cam: as given, from ``camera.json``, or TUM's by the folder's name."""
    height, width = read_image(frames[0].rgb).shape[:2]
    path = root / "camera.json"
    if intrinsics is not None:
        if len(intrinsics) not in (4, 9) or not np.isfinite(intrinsics).all() or min(intrinsics[:2]) <= 0.0:
            raise InputError("--intrinsics", "values", "fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2,k3; fx and fy positive")
        distortion = np.array(intrinsics[4:] or (0.0,) * 5, dtype=float)
        return Camera(width, height, *map(float, intrinsics[:4])), distortion, DEPTH_SCALE, None
    if path.is_file():
        try:
            stored = json.loads(path.read_text())
            K = np.asarray(stored["K"], dtype=float).reshape(3, 3)
            distortion = np.asarray(stored.get("distortion", [0.0] * 5), dtype=float).reshape(5)
            T_body_cam = stored.get("T_body_cam")
            T_body_cam = None if T_body_cam is None else np.asarray(T_body_cam, dtype=float).reshape(4, 4)
            camera = Camera.from_matrix(K, int(stored["width"]), int(stored["height"]))
            depth_scale = float(stored.get("depth_scale", DEPTH_SCALE))
            pose = np.eye(4) if T_body_cam is None else T_body_cam
            if not np.isfinite(np.concatenate([K.ravel(), distortion, pose.ravel(), [depth_scale]])).all():
                raise ValueError("finite numbers only")
            if min(camera.width, camera.height, K[0, 0], K[1, 1], depth_scale) <= 0:
                raise ValueError("sizes, focal lengths and depth_scale are positive")
            return camera, distortion, depth_scale, T_body_cam
        except (KeyError, TypeError, ValueError) as error:
            fields = "width, height, K (3x3)[, distortion (5), depth_scale, T_body_cam (4x4)]"
            raise InputError(path, "content", f"{fields} ({error})") from error
    for names, (pinhole, lens) in TUM_CAMERAS.items():
        if any(name in root.resolve().name for name in names):
            return Camera(640, 480, *pinhole).resized(width, height), np.array(lens), DEPTH_SCALE, None
    raise InputError(path, "file", "camera.json, a TUM folder name (fr1, fr2, fr3), or --intrinsics")


class SequenceWriter:
    """Writes a sequence frame by frame; ``close`` adds ``camera.json``, the mark of a whole recording."""

    def __init__(self, root: str | Path, camera: Camera, T_body_cam: np.ndarray) -> None:
        self.root = Path(root)
        if self.root.exists() and (not self.root.is_dir() or any(self.root.iterdir())):
            raise InputError(self.root, "folder", "an empty or new folder: a recording is never overwritten")
        for name in ("rgb", "depth"):
            (self.root / name).mkdir(parents=True, exist_ok=True)
        self.camera, self.T_body_cam = camera, np.asarray(T_body_cam, dtype=float)
        names = ("rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt", "controls.txt")
        self._files = {name: (self.root / name).open("w") for name in names}
        self._files["groundtruth.txt"].write("# timestamp tx ty tz qx qy qz qw\n")

    def append(
        self, time: float, rgb: np.ndarray, depth: np.ndarray, T_world_cam: np.ndarray, control: np.ndarray
    ) -> None:
        """Add one frame and the command that led to it.

        Args:
            time: Seconds.
            rgb: (height, width, 3) uint8.
            depth: (height, width) z-depth, m; readings beyond 13.1 m do not fit 16 bits and are stored as none.
            T_world_cam: (4, 4) true pose.
            control: the command since the frame before.
        """
        units = np.rint(np.asarray(depth, dtype=np.float64) * DEPTH_SCALE)
        units[(units > np.iinfo(np.uint16).max) | ~np.isfinite(units)] = 0
        colour_name, depth_name = f"rgb/{time:.6f}.png", f"depth/{time:.6f}.png"
        iio.imwrite(self.root / colour_name, rgb, compress_level=1)
        iio.imwrite(self.root / depth_name, units.astype(np.uint16), compress_level=1)
        self._files["rgb.txt"].write(f"{time:.6f} {colour_name}\n")
        self._files["depth.txt"].write(f"{time:.6f} {depth_name}\n")
        self._files["associations.txt"].write(f"{time:.6f} {colour_name} {time:.6f} {depth_name}\n")
        self._files["groundtruth.txt"].write(tum_line(time, T_world_cam))
        self._files["controls.txt"].write(f"{time:.6f} " + " ".join(f"{value:.7g}" for value in control) + "\n")

    def close(self) -> None:
        """Finish the index files and write ``camera.json``."""
        for file in self._files.values():
            file.close()
        stored = {
            "width": self.camera.width,
            "height": self.camera.height,
            "K": self.camera.K.tolist(),
            "distortion": [0.0] * 5,
            "depth_scale": DEPTH_SCALE,
            "T_body_cam": self.T_body_cam.tolist(),
        }
        with atomic_write(self.root / "camera.json") as temporary:
            temporary.write_text(json.dumps(stored, indent=1))
