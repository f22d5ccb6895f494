"""Read a recording (a TUM folder) as one episode of a data set: images as stored, poses, IMU readings, commands.

Depth is kept as it was recorded, whole units of ``1 / depth_scale`` metres, and not converted: nothing is rounded.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.data.datasets.episode import Block, Description, Episode
from vssm_gym.data.images import colour_image, depth_image
from vssm_gym.data.index import ASSOCIATION_TOLERANCE
from vssm_gym.data.sequences import Sequence, load_sequence
from vssm_gym.data.trajectories import interpolate
from vssm_gym.errors import InputError

BLOCK_FRAMES = 100  # frames in memory at once: 160 MB of a camera of 640 x 480 pixels
FEWEST_FRAMES = 2  # of a recording, for one step


def read_recording(root: str | Path, version: str) -> tuple[Description, Episode]:
    """Return a recording as a data set of one episode; its images are read as the episode's blocks are.

    Observations are ``rgb`` as stored, ``depth`` (height, width) in units, ``time`` (1,) s, ``T_world_cam`` (4, 4) m
    where poses were recorded (NaN at a frame without), and ``imu`` (k, 7) where readings were: those since the frame
    before, as the lines of ``imu.txt``, NaN after the last. The action of a step is the command between its two frames;
    a recording without commands has the action 0 of ``Discrete(1)``. Rewards are 0; the last step is truncated.

    Raises:
        InputError: no recording, one with fewer than two frames, or, while blocks are read, a damaged image.
    """
    sequence = load_sequence(root)
    if len(sequence.frames) < FEWEST_FRAMES:
        raise InputError(root, "frames", f"at least {FEWEST_FRAMES}; found {len(sequence.frames)}")
    commands = _commands(sequence)
    poses, readings = _poses(sequence), _readings(sequence)
    extra = {"time": sequence.times[:, None]}
    extra |= {} if poses is None else {"T_world_cam": poses}
    extra |= {} if readings is None else {"imu": readings}
    rgb, depth = _images(sequence, 0)
    largest = np.iinfo(depth.dtype).max if depth.dtype.kind in "ui" else np.inf
    spaces: dict[str, gym.Space[Any]] = {
        "rgb": gym.spaces.Box(0, 255, rgb.shape, np.uint8),
        "depth": gym.spaces.Box(0, largest, depth.shape, depth.dtype.type),
        **{name: gym.spaces.Box(-np.inf, np.inf, one.shape[1:], np.float64) for name, one in extra.items()},
    }
    action_space: gym.Space[Any] = gym.spaces.Discrete(1)
    if commands.dtype.kind == "f":
        action_space = gym.spaces.Box(-np.inf, np.inf, commands.shape[1:], np.float64)
    rate = 1.0 / float(np.median(np.diff(sequence.times)))
    name = Path(root).resolve().name
    description = Description(f"recording {name}", gym.spaces.Dict(spaces), action_space, rate, version)
    metadata = {
        "recording": name,
        "camera": sequence.calibration.as_json(),
        "notices": [notice.replace(str(root), name) for notice in sequence.notices],
        "version": version,
    }
    return description, Episode(f"recording {name}", None, metadata, _blocks(sequence, commands, extra))


def _blocks(sequence: Sequence, commands: np.ndarray, extra: dict[str, np.ndarray]) -> Iterator[Block]:
    """Yield blocks of at most ``BLOCK_FRAMES`` steps."""
    steps = len(sequence.frames) - 1
    for first in range(0, steps, BLOCK_FRAMES):
        end = min(first + BLOCK_FRAMES, steps)
        after = end + (end == steps)  # with the observation after the last step
        images = [_images(sequence, index) for index in range(first, after)]
        flags = np.arange(first, end) == steps - 1
        yield Block(
            {
                "rgb": np.stack([rgb for rgb, _ in images]),
                "depth": np.stack([depth for _, depth in images]),
                **{name: values[first:after] for name, values in extra.items()},
            },
            commands[first:end],
            np.zeros(end - first),
            np.zeros(end - first, bool),
            flags,
            [{}] * (after - first),
        )


def _images(sequence: Sequence, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return colour and depth of a frame as stored; raise InputError for an image that is damaged."""
    frame, camera, colour = sequence.frames[index], sequence.camera, sequence.colour
    of_colour = camera if colour is None else colour.view.camera
    rgb = colour_image(frame.rgb, (of_colour.width, of_colour.height))
    return rgb, depth_image(frame.depth, (camera.width, camera.height))


def _commands(sequence: Sequence) -> np.ndarray:
    """Return the command that led to each frame but the first ``(n - 1, ...)``; zeros of no dimension without any.

    A frame without a command within ``ASSOCIATION_TOLERANCE`` has NaN.
    """
    times, controls = sequence.times[1:], sequence.controls
    if not controls.size:
        return np.zeros(len(times), np.int64)
    order = np.argsort(controls[:, 0], kind="stable")
    stamps = controls[order, 0]
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    pair = np.stack([after - 1, np.minimum(after, len(stamps) - 1)])
    nearest = pair[np.argmin(np.abs(stamps[pair] - times), axis=0), np.arange(len(times))]
    near = np.abs(stamps[nearest] - times) <= ASSOCIATION_TOLERANCE
    return np.where(near[:, None], controls[order[nearest], 1:], np.nan)


def _poses(sequence: Sequence) -> np.ndarray | None:
    """Return true ``T_world_cam`` (n, 4, 4), m, NaN at a frame without; None where no pose was recorded."""
    if sequence.truth is None:
        return None
    poses = interpolate(*sequence.truth, sequence.times)
    poses[~sequence.has_pose()] = np.nan
    return poses


def _readings(sequence: Sequence) -> np.ndarray | None:
    """Return the IMU readings since the frame before, ``(n, k, 7)`` with NaN after the last; None without any."""
    if not len(sequence.imu):
        return None
    frame = np.searchsorted(sequence.times, sequence.imu[:, 0])  # the first frame that is not before the reading
    inside = frame < len(sequence.frames)  # readings after the last frame belong to no step
    frame, readings = frame[inside], sequence.imu[inside]
    counts = np.bincount(frame, minlength=len(sequence.frames))
    table = np.full((len(sequence.frames), max(int(counts.max()), 1), 7), np.nan)
    table[frame, np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame]] = readings
    return table
