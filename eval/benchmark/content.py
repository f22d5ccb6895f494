"""Hash what entries are given: recordings and drives, by true poses and images, and the numbers behind all tracks.

Poses are rounded, and images are reduced to rounded means of their tiles, because sums of floating-point numbers may
differ between processors in the last digit.
"""

import hashlib
from collections.abc import Iterable

import numpy as np

POSE_DIGITS = 3  # of metres and of radians or of entries of a rotation
TILES_ACROSS = 4  # along each side of an image
DEPTH_DIGITS, GREY_DIGITS = 1, -1  # of means in metres and in grey levels
IMAGES_APART = 10  # images of a run of which one is hashed


def content_of(poses: np.ndarray, images: Iterable[tuple[np.ndarray, np.ndarray]]) -> str:
    """Return the first 16 hex digits of the SHA-256 of true poses and of images.

    Args:
        poses: of any form.
        images: colour ``(height, width, 3)`` in grey levels and depth ``(height, width)`` in m, in order.
    """
    digest = hashlib.sha256(_rounded(poses, POSE_DIGITS))
    for rgb, depth in images:
        digest.update(_rounded(_tiles(rgb), GREY_DIGITS) + _rounded(_tiles(depth), DEPTH_DIGITS))
    return digest.hexdigest()[:16]


def _tiles(image: np.ndarray) -> np.ndarray:
    """Return the mean of each tile of an image."""
    rows = np.array_split(np.nan_to_num(np.asarray(image, float)), TILES_ACROSS)
    return np.array([[tile.mean() for tile in np.array_split(row, TILES_ACROSS, axis=1)] for row in rows])


def _rounded(values: np.ndarray, digits: int) -> bytes:
    """Return the bytes of rounded values, with one zero."""
    return (np.asarray(values, np.float64).round(digits) + 0.0).tobytes()
