"""Read grey images of ROS maps: PGM (P2, P5) here, PNG by Pillow; sizes are checked before anything is unpacked."""

import io
import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_bytes

IMAGE_BYTES = 128 << 20  # largest file
IMAGE_SIDE, IMAGE_PIXELS = 16384, 1 << 25  # largest side and number of pixels
_HEADER = re.compile(rb"(P[25])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d{1,6})" + rb"\s")


def read_grey(path: Path) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Return the image's grey values, 0 black to 255 white (the mean of colour channels), and its opacity in [0, 1].

    Values of 16 bits are scaled to 255, those of a PGM with a small maximum are not: a raw map may count to 100. Raises
    InputError for other formats, sizes beyond the bounds and truncated files.
    """
    content = read_bytes(path, IMAGE_BYTES)
    if content[:2] in (b"P2", b"P5"):
        grey = _pgm(content, path)
        return grey, np.ones_like(grey)
    return _png(content, path)


def _check_size(width: int, height: int, path: Path) -> None:
    if not (0 < width <= IMAGE_SIDE and 0 < height <= IMAGE_SIDE and width * height <= IMAGE_PIXELS):
        expected = f"1 to {IMAGE_SIDE} pixels a side and at most {IMAGE_PIXELS:,} in all; found {width} x {height}"
        raise InputError(path, "image", expected)


def _pgm(content: bytes, path: Path) -> np.ndarray:
    header = _HEADER.match(content[:4096])
    if header is None:
        raise InputError(path, "image", "a PGM header: P2 or P5, width, height and largest value")
    width, height, most = (int(header[k]) for k in (2, 3, 4))
    _check_size(width, height, path)
    if not 0 < most < 65536:
        raise InputError(path, "image", f"a largest value from 1 to 65535; found {most}")
    count = width * height
    if header[1] == b"P5":
        kind = np.dtype(">u2" if most > 255 else "u1")
        if len(content) - header.end() < count * kind.itemsize:
            found = len(content) - header.end()
            raise InputError(
                path, "image", f"{count * kind.itemsize:,} bytes of {width} x {height} pixels; found {found:,}"
            )
        values = np.frombuffer(content, kind, count, header.end())
    else:
        words = re.sub(rb"#[^\n]*", b"", content[header.end() :]).split(None, count)[:count]
        if len(words) < count or any(not word.isdigit() or len(word) > 5 for word in words):
            raise InputError(path, "image", f"{count:,} whole numbers, one a pixel; found {len(words):,} words")
        values = np.array(words, dtype=np.int64)
    if values.max() > most:
        raise InputError(path, "image", f"values up to the header's {most}; found {values.max()}")
    return values.reshape(height, width).astype(np.float32) * np.float32(255.0 / most if most > 255 else 1.0)


def _png(content: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is checked here
            image = Image.open(io.BytesIO(content), formats=["PNG"])
        _check_size(*image.size, path)
        if image.mode.startswith("I"):
            grey = np.asarray(image, dtype=np.float32) / np.float32(257.0)
            return grey, np.ones_like(grey)
        channels = np.asarray(image.convert("RGBA"), dtype=np.float32)
    except InputError:
        raise
    except Exception as error:  # Pillow meets damaged files with errors of many types
        raise InputError(path, "image", f"a PGM (P2, P5) or PNG image ({type(error).__name__}: {error})") from error
    return channels[..., :3].mean(axis=-1), channels[..., 3] / np.float32(255.0)
