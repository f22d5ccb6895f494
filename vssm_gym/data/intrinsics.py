"""Find the calibration of a recording's camera: given by the user, in ``camera.json``, or published by TUM."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json
from vssm_gym.files.numbers import floats, whole
from vssm_gym.geometry.camera import Camera

DEPTH_SCALE = 5000.0  # TUM's: one unit is 0.2 mm

# Published intrinsics of the TUM RGB-D cameras at 640x480: fx fy cx cy, k1 k2 p1 p2 k3; by a word of the folder's name.
TUM_CAMERAS = {
    ("fr1", "freiburg1"): ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    ("fr2", "freiburg2"): ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    ("fr3", "freiburg3"): ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
INTRINSICS_BYTES = 1 << 20  # of a calibration file
LARGEST_SIDE = 1 << 14  # pixels
LARGEST_FOCAL = 1e6  # pixels, of focal lengths and the principal point
LARGEST_COEFFICIENT = 1e3  # of the lens; those of real lenses are below 100
SCALES = (1.0, 1e6)  # units a metre: floats in metres have 1, micrometres a million
FARTHEST_CAMERA = 100.0  # m, of the camera on its body
ROTATION_ROUNDING = 1e-3  # of a rotation written with four digits
_PINHOLE = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])  # entries of K that may differ from 0
MIDDLE = (0.3, 0.7)  # where a principal point lies, as a share of width and height


@dataclass(frozen=True)
class CameraCalibration:
    """Hold the camera's calibration and the storage of depth."""

    camera: Camera  # of the images as recorded (before undistortion)
    distortion: np.ndarray  # (5,) k1 k2 p1 p2 k3
    depth_scale: float  # units a metre
    T_body_cam: np.ndarray | None  # (4, 4)


def read_calibration(root: Path, width: int, height: int, given: tuple[float, ...] | None) -> CameraCalibration:
    """Read the calibration of images of ``width x height`` pixels.

    Args:
        root: the sequence's folder.
        width: of the images, as found in them.
        height: of the images.
        given: ``fx fy cx cy [k1 k2 p1 p2 k3]`` of the recorded images, in place of the folder's calibration.

    Raises:
        InputError: no calibration, a malformed one, or one of images of another size.
    """
    path = root / "camera.json"
    if given is not None:
        return _as_given(given, width, height)
    if path.is_file():
        calibration = _from_json(path)
        stated = (calibration.camera.width, calibration.camera.height)
        if stated != (width, height):
            found = f"found {stated[0]}x{stated[1]}"
            raise InputError(path, "width, height", f"the images' size, {width}x{height}; {found}")
        _check_middle(calibration.camera, path, "K")
        return calibration
    for names, (pinhole, lens) in TUM_CAMERAS.items():
        if any(name in root.resolve().name for name in names):
            camera = Camera(640, 480, *pinhole).resized(width, height)
            return CameraCalibration(camera, np.array(lens), DEPTH_SCALE, None)
    raise InputError(path, "file", "camera.json, a TUM folder name (fr1, fr2, fr3), or --intrinsics")


def _as_given(given: tuple[float, ...], width: int, height: int) -> CameraCalibration:
    if len(given) not in (4, 9) or not np.isfinite(given).all() or min(given[:2]) <= 0.0:
        raise InputError("--intrinsics", "values", "fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2,k3; fx and fy positive")
    fx, fy, cx, cy = map(float, given[:4])
    camera = Camera(width, height, fx, fy, cx, cy)
    _check_middle(camera, "--intrinsics", "values")
    return CameraCalibration(camera, np.array(given[4:] or (0.0,) * 5, dtype=float), DEPTH_SCALE, None)


def _check_middle(camera: Camera, source: object, field: str) -> None:
    cx, cy = float(camera.K[0, 2]), float(camera.K[1, 2])
    if not all(MIDDLE[0] <= share <= MIDDLE[1] for share in (cx / camera.width, cy / camera.height)):
        size = f"{camera.width}x{camera.height}"
        found = f"found cx, cy = {cx:g}, {cy:g}: intrinsics of another size?"
        raise InputError(source, field, f"a principal point near the middle of the {size} images; {found}")


def _from_json(path: Path) -> CameraCalibration:
    stored = read_json(path, INTRINSICS_BYTES, "a camera's calibration")
    fields = "width, height, K (3x3)[, distortion (5), depth_scale, T_body_cam (4x4)]"
    if not isinstance(stored, dict) or not {"width", "height", "K"} <= stored.keys():
        raise InputError(path, "content", fields)
    width, height = (whole(stored[name], path, name, least=1, most=LARGEST_SIDE) for name in ("width", "height"))
    K = floats(stored["K"], (3, 3), path, "K", largest=LARGEST_FOCAL)
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and np.array_equal(K * _PINHOLE, K) and K[2, 2] == 1.0):
        raise InputError(path, "K", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, pixels")
    distortion = floats(stored.get("distortion", [0.0] * 5), (5,), path, "distortion", largest=LARGEST_COEFFICIENT)
    scale = float(floats(stored.get("depth_scale", DEPTH_SCALE), (), path, "depth_scale"))
    if not SCALES[0] <= scale <= SCALES[1]:
        raise InputError(path, "depth_scale", f"units a metre, from {SCALES[0]:g} to {SCALES[1]:g}; found {scale:g}")
    T_body_cam = stored.get("T_body_cam")
    if T_body_cam is not None:
        T_body_cam = _rigid(floats(T_body_cam, (4, 4), path, "T_body_cam", largest=FARTHEST_CAMERA), path)
    return CameraCalibration(Camera.from_matrix(K, width, height), distortion, scale, T_body_cam)


def _rigid(T: np.ndarray, path: Path) -> np.ndarray:
    """Return ``T`` (4, 4); raise InputError where it is no rotation and translation."""
    R = T[:3, :3]
    off = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max())
    if off > ROTATION_ROUNDING or np.linalg.det(R) < 0.0:
        raise InputError(path, "T_body_cam", "a rotation and a translation: no scale, no mirror, last row 0 0 0 1")
    return T
