"""Read one image file of a recording, or raise one clear error that names the file."""

from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from vssm_gym.errors import InputError
from vssm_gym.files.bounded import open_file

FORMATS = ("PNG", "JPEG", "TIFF")
MOST_PIXELS = 1 << 24  # of an image, 4096 x 4096; cameras of robots have a tenth


def read_image(path: Path, size: tuple[int, int] | None) -> np.ndarray:
    """Read the pixels of an image file, as stored; they are decoded after the size was compared with ``size``."""
    with open_file(path, "an existing image, as the sequence's index lists it") as file:
        try:
            with Image.open(file, formats=FORMATS) as image:
                found = image.size
                if found[0] * found[1] <= MOST_PIXELS and size in (None, found):
                    return np.array(image.convert("RGB") if image.mode == "P" else image)
        except UnidentifiedImageError as error:
            raise InputError(path, "pixels", f"a readable image ({' or '.join(FORMATS)})") from error
        except Exception as error:  # Pillow's decoders raise errors of many types on damaged files
            raise InputError(path, "pixels", f"a readable image ({error})") from error
    expected = f"at most {MOST_PIXELS:,} pixels"
    if size is not None:
        expected = f"{size[0]}x{size[1]} pixels, as the sequence's other images"
    raise InputError(path, "size", f"{expected}; found {found[0]}x{found[1]}")


def image_mode(path: Path) -> str:
    """Return Pillow's name of the pixels' layout ("RGB", "I;16", ...) from the file's header."""
    with open_file(path, "an existing image, as the sequence's index lists it") as file:
        try:
            with Image.open(file, formats=FORMATS) as header:
                return header.mode
        except Exception as error:  # as in read_image
            raise InputError(path, "pixels", f"a readable image ({error})") from error


def colour_image(path: Path, size: tuple[int, int] | None) -> np.ndarray:
    """Read a colour or grey image as RGB uint8; ``size`` (width, height) is the expected one."""
    rgb = read_image(path, size)
    if rgb.dtype != np.uint8:
        raise InputError(path, "pixels", "8 bits a colour channel")
    if rgb.ndim == 2 or rgb.shape[2] < 3:  # grey, maybe with transparency
        rgb = np.repeat(rgb.reshape(*rgb.shape[:2], -1)[..., :1], 3, axis=2)
    return rgb[..., :3]


def depth_image(path: Path, size: tuple[int, int] | None) -> np.ndarray:
    """Read depth as stored, one channel; ``size`` (width, height) is the expected one."""
    depth = read_image(path, size)
    if depth.ndim != 2 or depth.dtype.kind not in "uif" or depth.dtype.itemsize < 2:
        raise InputError(path, "pixels", f"one channel of depth, 16 bits at least; found {_layout(depth)}")
    return depth


def _layout(image: np.ndarray) -> str:
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"{channels} of {8 * image.dtype.itemsize} bits"
