"""Read one image file of a recording, or raise one clear error that names the file."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from vssm_gym.errors import InputError


def read_image(path: Path) -> np.ndarray:
    """Read the pixels of an image file, as stored."""
    if not path.is_file():
        raise InputError(path, "file", "an existing image, as the sequence's index lists it")
    try:
        return iio.imread(path, plugin="pillow")
    except (OSError, ValueError, SyntaxError) as error:  # Pillow calls a broken PNG chunk a syntax error
        why = "not a PNG, JPEG or TIFF file" if "given uri" in str(error) else error
        raise InputError(path, "pixels", f"a readable image ({why})") from error


def colour_image(path: Path, size: tuple[int, int] | None) -> np.ndarray:
    """Read a colour or grey image as RGB uint8; ``size`` (width, height) is the expected one."""
    rgb = read_image(path)
    _check_size(path, rgb, size)
    if rgb.dtype != np.uint8:
        raise InputError(path, "pixels", "8 bits a colour channel")
    if rgb.ndim == 2 or rgb.shape[2] < 3:  # grey, maybe with transparency
        rgb = np.repeat(rgb.reshape(*rgb.shape[:2], -1)[..., :1], 3, axis=2)
    return rgb[..., :3]


def depth_image(path: Path, size: tuple[int, int] | None) -> np.ndarray:
    """Read depth as stored, one channel; ``size`` (width, height) is the expected one."""
    depth = read_image(path)
    _check_size(path, depth, size)
    if depth.ndim != 2 or depth.dtype.kind not in "uif" or depth.dtype.itemsize < 2:
        raise InputError(path, "pixels", f"one channel of depth, 16 bits at least; found {_layout(depth)}")
    return depth


def _layout(image: np.ndarray) -> str:
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"{channels} of {8 * image.dtype.itemsize} bits"


def _check_size(path: Path, image: np.ndarray, size: tuple[int, int] | None) -> None:
    found = image.shape[1::-1]
    if size is not None and found != size:
        expected = f"{size[0]}x{size[1]} pixels, as the sequence's other images"
        raise InputError(path, "size", f"{expected}; found {found[0]}x{found[1]}")
