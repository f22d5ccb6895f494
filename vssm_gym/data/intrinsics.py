"""Find the calibration of a recording's camera: given by the user, in ``camera.json``, or published by TUM."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera

DEPTH_SCALE = 5000.0  # TUM's: one unit is 0.2 mm

# Published intrinsics of the TUM RGB-D cameras at 640x480: fx fy cx cy, k1 k2 p1 p2 k3; by a word of the folder's name.
TUM_CAMERAS = {
    ("fr1", "freiburg1"): ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    ("fr2", "freiburg2"): ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    ("fr3", "freiburg3"): ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
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
    except (KeyError, TypeError, ValueError) as error:
        fields = "width, height, K (3x3)[, distortion (5), depth_scale, T_body_cam (4x4)]"
        raise InputError(path, "content", f"{fields} ({error})") from error
    return CameraCalibration(camera, distortion, depth_scale, T_body_cam)
