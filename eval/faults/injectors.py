"""Inject faults into a stream of RGB-D images: what a camera delivers when it fails, and how it is carried off.

A fault of the *image* replaces what the camera delivers; the camera itself moves on. A fault of the *motion* leaves the
images intact: the camera is suddenly elsewhere. In a recording that is another order of its frames.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

from vssm_gym.errors import InputError

Image = tuple[np.ndarray, np.ndarray]  # RGB uint8 (height, width, 3) and z-depth float32 (height, width), m; 0: none
# (images as they should be up to the present one, number of images before the fault, generator) -> image delivered
ImageFault = Callable[[Sequence[Image], int, np.random.Generator], Image]

CARD_DISTANCE = 0.3  # m from the lens
CARD_NOISE = (2.0, 0.001)  # std of its grey levels and of its depth, m: a real sensor repeats no image
SCALE_ERROR = 1.2  # of the depth
DEPTH_LAG = 20  # images that the depth is older than the colour
KIDNAP, SHOVE = 0.5, 0.25  # m that the camera is carried, within one image


def blackout(images: Sequence[Image], before: int, rng: np.random.Generator) -> Image:
    """Return a black image without depth."""
    rgb, depth = images[-1]
    return np.zeros_like(rgb), np.zeros_like(depth)


def frozen(images: Sequence[Image], before: int, rng: np.random.Generator) -> Image:
    """Return the last image before the fault."""
    return images[max(before - 1, 0)]


def grey_card(images: Sequence[Image], before: int, rng: np.random.Generator) -> Image:
    """Return the image of a grey card close to the lens."""
    rgb, depth = images[-1]
    grey = np.rint(rng.normal(128.0, CARD_NOISE[0], rgb.shape)).astype(np.uint8)
    return grey, rng.normal(CARD_DISTANCE, CARD_NOISE[1], depth.shape).astype(np.float32)


def scaled_depth(images: Sequence[Image], before: int, rng: np.random.Generator) -> Image:
    """Return the image with its depth too large by a fifth."""
    rgb, depth = images[-1]
    return rgb, np.float32(SCALE_ERROR) * depth


def swapped_depth(images: Sequence[Image], before: int, rng: np.random.Generator) -> Image:
    """Return the colour of the present image with the depth of an earlier one."""
    return images[-1][0], images[max(len(images) - 1 - DEPTH_LAG, 0)][1]


def mirrored(images: Sequence[Image], before: int, rng: np.random.Generator) -> Image:
    """Return the image with left and right exchanged."""
    rgb, depth = images[-1]
    return rgb[:, ::-1].copy(), depth[:, ::-1].copy()


IMAGE_FAULTS: dict[str, ImageFault] = {
    "blackout": blackout,
    "frozen": frozen,
    "grey card": grey_card,
    "scaled depth": scaled_depth,
    "swapped depth": swapped_depth,
    "mirrored": mirrored,
}
MOTION_FAULTS = ("kidnap", "shove")  # carried elsewhere and back after a while; jerked, from where it moves on


def reordered(
    name: str, T_world_cam: Float[np.ndarray, "n 4 4"], order: Int[np.ndarray, "m"], before: int, during: int
) -> Int[np.ndarray, "m"]:
    """Return the frames of a recording in the order in which a camera that is carried off would take them.

    Args:
        name: one of ``MOTION_FAULTS``.
        T_world_cam: true poses of all frames of the recording.
        order: the frames without the fault, consecutive.
        before: frames before the fault.
        during: frames that a kidnapped camera spends elsewhere.

    Raises:
        InputError: the camera never gets far enough away.
    """
    stays = during if name == "kidnap" else len(order) - before
    last = order[before - 1]
    apart = np.linalg.norm(T_world_cam[:, :3, 3] - T_world_cam[last, :3, 3], axis=1)
    apart[len(T_world_cam) - stays + 1 :] = 0.0  # so that enough frames follow
    away = min(KIDNAP if name == "kidnap" else SHOVE, apart.max())  # a small space has no place beyond its farthest
    places = np.flatnonzero(apart >= away)
    places = places[np.argsort(places < last, kind="stable")]  # those that follow first
    if away < SHOVE:
        raise InputError("faults", "recording", f"a camera that moves at least {SHOVE} m away from frame {last}")
    result = order.copy()
    result[before : before + stays] = places[0] + np.arange(stays)
    return result
