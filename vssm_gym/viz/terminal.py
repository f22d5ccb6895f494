"""Show images in a terminal: one character shows two pixels, an upper half block ``▀`` in one colour on another.

A terminal's characters are about twice as high as wide, so that these pixels are square. Text works through SSH;
colours are 24-bit, or the 6 x 6 x 6 cube for terminals with 256 colours.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

Colours = Literal["true", "256"]

RESET = "\x1b[0m"
NO_READING = (70, 20, 60)  # of a depth image: no grey, so that it is not mistaken for a distance
_CUBE = np.array([0, 95, 135, 175, 215, 255])  # the levels of xterm's colours 16 to 231


def half_blocks(image: UInt8[np.ndarray, "height width 3"], colours: Colours = "true") -> list[str]:
    """Convert ``image`` to lines of text, two rows of pixels a line; an odd last row is completed with black.

    A colour is written where it changes, and each line ends in the terminal's own colours.
    """
    if len(image) % 2:
        image = np.concatenate([image, np.zeros_like(image[:1])])
    return [_line(upper, lower, colours) for upper, lower in zip(image[0::2], image[1::2], strict=True)]


def _line(upper: np.ndarray, lower: np.ndarray, colours: Colours) -> str:
    parts, front, back = [], "", ""
    for top, bottom in zip(_codes(upper, colours), _codes(lower, colours), strict=True):
        changed = [f"38;{top}"] * (top != front) + [f"48;{bottom}"] * (bottom != back)
        parts.append(f"\x1b[{';'.join(changed)}m▀" if changed else "▀")
        front, back = top, bottom
    return "".join(parts) + RESET


def _codes(pixels: np.ndarray, colours: Colours) -> list[str]:
    if colours == "true":
        return [f"2;{r};{g};{b}" for r, g, b in pixels.tolist()]
    level = np.abs(pixels[..., None].astype(int) - _CUBE).argmin(axis=-1)
    return [f"5;{code}" for code in (16 + level @ (36, 6, 1)).tolist()]


def depth_picture(
    depth: Float[np.ndarray, "height width"], max_depth: float = 6.0
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw depth in grey from white (near) to black (``max_depth`` m and beyond); purple where there is no reading."""
    grey = np.rint(255.0 * (1.0 - np.clip(depth / max_depth, 0.0, 1.0))).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=-1)
    picture[~(depth > 0.0)] = NO_READING
    return picture


def side_by_side(
    pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]], columns: int, rows: int, colours: Colours = "true"
) -> list[str]:
    """Place ``pictures`` beside each other at equal height, as large as fits into ``columns`` x ``rows`` characters."""
    gaps = len(pictures) - 1
    ratios = [picture.shape[1] / picture.shape[0] for picture in pictures]
    height = min(2 * rows, int((columns - gaps) / sum(ratios)))
    height = max(2, height - height % 2)
    panels = []
    for picture, ratio in zip(pictures, ratios, strict=True):
        size = (max(1, int(ratio * height)), height)
        panels.append(half_blocks(np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX)), colours))
    return [" ".join(line) for line in zip(*panels, strict=True)]
