"""Find the calibration of a recording's cameras: given by the user, in ``camera.json``, or published by TUM."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.data.index import Frame
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json
from vssm_gym.files.numbers import floats, whole
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import PARAMETERS, PRIOR_STD, ColourCamera

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
class ColourCalibration:
    """Hold the calibration of colour images that are not registered to depth, and how well it is known."""

    view: ColourCamera  # of the colour images as recorded
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(5))  # k1 k2 p1 p2 k3
    std: np.ndarray = field(default_factory=lambda: PRIOR_STD)  # (10,) of the parameters of ColourCamera


@dataclass(frozen=True)
class CameraCalibration:
    """Hold the calibration of the depth images, and of the colour images, and the storage of depth."""

    camera: Camera  # of the images as recorded (before undistortion)
    distortion: np.ndarray  # (5,) k1 k2 p1 p2 k3
    depth_scale: float  # units a metre
    T_body_cam: np.ndarray | None  # (4, 4)
    colour: ColourCalibration | None = None  # None: colour is registered to depth, pixel by pixel

    def as_json(self) -> dict[str, Any]:
        """Return the content of ``camera.json``."""
        stored = _stored(self.camera, self.distortion) | {"depth_scale": self.depth_scale}
        if self.T_body_cam is not None:
            stored["T_body_cam"] = self.T_body_cam.tolist()
        if self.colour is not None:
            view = self.colour.view
            stored["colour"] = _stored(view.camera, self.colour.distortion)
            stored["colour"] |= {"T_depth_colour": np.asarray(view.T_depth_colour).tolist()}
            if self.colour.std.any():  # a true one has none
                stored["colour"] |= {"std": self.colour.std.tolist()}
        return stored


def _stored(camera: Camera, distortion: np.ndarray) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "distortion": np.asarray(distortion).tolist(),
    }


def read_calibration(
    root: Path,
    width: int,
    height: int,
    given: tuple[float, ...] | None,
    of_colour: tuple[int, int],
    first: Frame,
) -> CameraCalibration:
    """Read the calibration of depth images of ``width x height`` pixels.

    Args:
        root: the sequence's folder.
        width: of the depth images, as found in them.
        height: of them.
        given: ``fx fy cx cy [k1 k2 p1 p2 k3]`` of the recorded images, in place of the folder's calibration.
        of_colour: width and height of the colour images.
        first: whose images have these sizes.

    Raises:
        InputError: no calibration, a malformed one, or one of images of another size.
    """
    path = root / "camera.json"
    if given is not None and path.is_file() and "colour" in read_json(path):
        expected = "none for a folder whose camera.json has the field colour: it calibrates both cameras"
        raise InputError(path, "intrinsics", expected)
    calibration = _from_json(path) if given is None and path.is_file() else None
    if calibration is not None and calibration.colour is not None:
        stated = (calibration.colour.view.camera.width, calibration.colour.view.camera.height)
        if stated != of_colour:
            expected = f"the colour images' size, {of_colour[0]}x{of_colour[1]}"
            raise InputError(path, "colour.width, colour.height", f"{expected}; found {stated[0]}x{stated[1]}")
    elif of_colour != (width, height):
        expected = f"the size of {first.rgb.name}, {of_colour[0]}x{of_colour[1]}: depth registered to colour"
        remedy = "if they are two cameras, state the field colour in camera.json"
        raise InputError(first.depth, "size", f"{expected}; found {width}x{height}; {remedy}")
    if given is not None:
        return _as_given(given, width, height)
    if calibration is not None:
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
    fields = "width, height, K (3x3)[, distortion (5), depth_scale, T_body_cam (4x4), colour]"
    if not isinstance(stored, dict) or not {"width", "height", "K"} <= stored.keys():
        raise InputError(path, "content", fields)
    camera, distortion = _pinhole(stored, path)
    scale = float(floats(stored.get("depth_scale", DEPTH_SCALE), (), path, "depth_scale"))
    if not SCALES[0] <= scale <= SCALES[1]:
        raise InputError(path, "depth_scale", f"units a metre, from {SCALES[0]:g} to {SCALES[1]:g}; found {scale:g}")
    T_body_cam = stored.get("T_body_cam")
    if T_body_cam is not None:
        T_body_cam = _rigid(T_body_cam, path, "T_body_cam")
    colour = None if stored.get("colour") is None else _colour(stored["colour"], path)
    return CameraCalibration(camera, distortion, scale, T_body_cam, colour)


def _colour(stored: Any, path: Path) -> ColourCalibration:
    """Read the field ``colour``: a camera, its pose on the depth camera, and the standard deviations of both."""
    if not isinstance(stored, dict) or not {"width", "height", "K"} <= stored.keys():
        expected = "width, height, K (3x3)[, distortion (5), T_depth_colour (4x4), std (10)] of the colour images"
        raise InputError(path, "colour", expected)
    camera, distortion = _pinhole(stored, path, "colour.")
    _check_middle(camera, path, "colour.K")
    T = _rigid(stored.get("T_depth_colour", np.eye(4).tolist()), path, "colour.T_depth_colour")
    std = stored.get("std", PRIOR_STD.tolist())
    std = floats(std, (PARAMETERS,), path, "colour.std", largest=FARTHEST_CAMERA, positive=True)
    return ColourCalibration(ColourCamera(camera, T), distortion, std)


def _pinhole(stored: dict[str, Any], path: Path, within: str = "") -> tuple[Camera, np.ndarray]:
    """Read size, K and distortion; ``within`` comes before the fields' names in errors."""
    width, height = (
        whole(stored[name], path, within + name, least=1, most=LARGEST_SIDE) for name in ("width", "height")
    )
    K = floats(stored["K"], (3, 3), path, f"{within}K", largest=LARGEST_FOCAL)
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and np.array_equal(K * _PINHOLE, K) and K[2, 2] == 1.0):
        raise InputError(path, f"{within}K", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, pixels")
    lens = stored.get("distortion", [0.0] * 5)
    distortion = floats(lens, (5,), path, f"{within}distortion", largest=LARGEST_COEFFICIENT)
    return Camera.from_matrix(K, width, height), distortion


def _rigid(value: Any, path: Path, name: str) -> np.ndarray:
    """Return a rigid motion (4, 4); raise InputError where it is no rotation and translation."""
    T = floats(value, (4, 4), path, name, largest=FARTHEST_CAMERA)
    R = T[:3, :3]
    off = max(np.abs(R @ R.T - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max())
    if off > ROTATION_ROUNDING or np.linalg.det(R) < 0.0:
        raise InputError(path, name, "a rotation and a translation: no scale, no mirror, last row 0 0 0 1")
    return T
