"""Pair the images of a TUM folder: by ``associations.txt``, or ``rgb.txt`` and ``depth.txt`` with nearest stamps.

Recordings have flaws: stamps out of order or repeated, missing images, colour without depth, gaps. Reading continues as
long as a frame is left; each flaw is reported once, in a notice for the user.
"""

import heapq
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from vssm_gym.data.images import image_mode
from vssm_gym.data.trajectories import numbered_lines
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import inside, is_file

T = TypeVar("T")
Row = tuple[float, list[str]]  # of an index file: its time (s) and all its words

ASSOCIATION_TOLERANCE = 0.02  # s between a colour and a depth image of one frame, or between a frame and its pose
TRIED_PAIRS = 100  # of an index, to see which image is the depth: all may be missing
NOTICED_GAP = 0.5  # s between two frames that gives a notice, where it is also five times the median


@dataclass(frozen=True)
class Frame:
    """Describe one RGB-D frame on disk, stamped with its colour image's time (s)."""

    time: float
    rgb: Path
    depth: Path


def read_frames(root: Path) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Read the frames of a sequence, sorted, with unique stamps and existing images; and notices of flaws in the index.

    Raises:
        InputError: an index file is missing or malformed, or no frame is left.
    """
    notices: list[str] = []
    pairs = root / "associations.txt"
    if pairs.is_file():
        rows = _clean(pairs, _rows(pairs, 4), notices)
        colour, depth = 1, 3
        if _depth_comes_first(root, rows):  # as in ICL-NUIM, and where TUM's script was called so
            colour, depth = 3, 1
        at = lambda name: inside(root, name, pairs, "images")
        frames = [Frame(float(words[colour - 1]), at(words[colour]), at(words[depth])) for _, words in rows]
        frames.sort(key=lambda frame: frame.time)
        frames = _existing(pairs, frames, [(frame.rgb, frame.depth) for frame in frames], notices)
    else:
        colour_rows, depth_rows = (_images(root / name, notices) for name in ("rgb.txt", "depth.txt"))
        frames = _associated(root, colour_rows, depth_rows, notices)
    _note_gaps(np.array([frame.time for frame in frames]), notices)
    return tuple(frames), tuple(notices)


def associate_one_to_one(first: np.ndarray, second: np.ndarray, tolerance: float) -> list[tuple[int, int]]:
    """Pair stamps at most ``tolerance`` s apart, each used once: the nearest pair first (TUM's ``associate.py``).

    Both lists ascend strictly; the index pairs are in the order of ``first``. The nearest pair of what is left has no
    stamp between its two: of all stamps in order, only neighbours are compared, so that dense lists cost
    ``O(n log n)``.
    """
    n = len(first)
    stamps = np.concatenate([first, second])
    order = [int(k) for k in np.argsort(stamps, kind="stable")]  # k < n: first[k]; else second[k - n]
    left = dict(zip(order, [-1, *order][:-1], strict=True))  # -1: no stamp on this side
    right = dict(zip(order, [*order, -1][1:], strict=True))
    nearest: list[tuple[float, int, int]] = []

    def consider(k: int, m: int) -> None:
        """Add two neighbours where they are one of each list and near enough."""
        i, j = min(k, m), max(k, m) - n
        if -1 in (k, m) or not i < n <= j + n:
            return
        if first[i] - tolerance - 1e-9 <= second[j] <= first[i] + tolerance + 1e-9:
            heapq.heappush(nearest, (abs(second[j] - first[i]), i, j))

    for k, m in pairwise(order):
        consider(k, m)
    pairs, paired = [], set()
    while nearest:
        _, i, j = heapq.heappop(nearest)
        if i in paired or j + n in paired:
            continue
        pairs.append((i, j))
        paired |= {i, j + n}
        for k in (i, j + n):  # their neighbours become each other's
            before, after = left[k], right[k]
            left[after], right[before] = before, after
        consider(before, after)
    return sorted(pairs)


def _rows(path: Path, columns: int) -> list[Row]:
    """Read the lines of an index file: the time that opens each (s), and all its words. Every other word is a time."""
    if not path.is_file():
        raise InputError(path, "file", "this index file of the sequence")
    rows = []
    for number, line in numbered_lines(path):
        words = line.split()
        try:
            times = [float(word) for word in words[:columns:2]]
        except ValueError:
            times = [math.nan]
        if len(words) < columns or not np.isfinite(times).all():
            raise InputError(path, f"line {number}", f"{columns} columns, a time in seconds first, then a file")
        rows.append((times[0], words))
    if not rows:
        raise InputError(path, "file", "at least one image")
    return rows


def _clean(path: Path, rows: list[Row], notices: list[str]) -> list[Row]:
    """Sort the rows by time and keep the first of those with equal stamps."""
    times = [time for time, _ in rows]
    if backwards := int(np.sum(np.diff(times) < 0.0)):
        notices.append(f"{path.name}: time runs backwards {_times(backwards)}; sorted")
    kept: list[Row] = []
    for row in sorted(rows, key=lambda row: row[0]):
        if not kept or row[0] > kept[-1][0]:
            kept.append(row)
    if doubled := len(rows) - len(kept):
        notices.append(f"{path.name}: {doubled} of {len(rows)} lines repeat a stamp; left out")
    return kept


def _images(index: Path, notices: list[str]) -> list[Row]:
    """Read the rows of an index of one kind of images, sorted by time, without repeated and missing ones."""
    rows = _clean(index, _rows(index, 2), notices)
    return _existing(index, rows, [(inside(index.parent, words[1], index, "images"),) for _, words in rows], notices)


def _existing(index: Path, items: list[T], images: list[tuple[Path, ...]], notices: list[str]) -> list[T]:
    """Keep those of ``items`` whose images exist."""
    missing = [next((path for path in paths if not is_file(path)), None) for paths in images]
    kept = [item for item, gone in zip(items, missing, strict=True) if gone is None]
    first = next((gone for gone in missing if gone is not None), None)
    if not kept:
        raise InputError(index, "images", f"existing files; all {len(items)} are missing, as {first}")
    if first is not None:
        lost = len(items) - len(kept)
        notices.append(f"{index.name}: {lost} of {len(items)} lines name a missing image, as {first}; left out")
    return kept


def _associated(root: Path, colour: list[Row], depth: list[Row], notices: list[str]) -> list[Frame]:
    """Pair the colour and depth images with the nearest stamps to frames."""
    of_colour, of_depth = (np.array([time for time, _ in rows]) for rows in (colour, depth))
    pairs = associate_one_to_one(of_colour, of_depth, ASSOCIATION_TOLERANCE)
    if not pairs:
        raise InputError(root, "rgb.txt, depth.txt", f"images within {ASSOCIATION_TOLERANCE} s of each other")
    if alone := len(colour) - len(pairs):
        limit = f"{1000 * ASSOCIATION_TOLERANCE:g} ms"
        notices.append(f"rgb.txt: {alone} of {len(colour)} images have no depth image within {limit}; left out")
    return [Frame(colour[i][0], root / colour[i][1][1], root / depth[j][1][1]) for i, j in pairs]


def _depth_comes_first(root: Path, rows: list[Row]) -> bool:
    """Return True if the images named first have one 16-bit channel and those named second are in colour."""
    for _, words in rows[:TRIED_PAIRS]:
        try:
            first, second = (image_mode(inside(root, words[i], root, "images")) for i in (1, 3))
        except InputError:
            continue  # missing or damaged: try the next pair
        return first.startswith(("I", "F")) and second in ("RGB", "RGBA", "P")
    return False


def _note_gaps(times: np.ndarray, notices: list[str]) -> None:
    """Add a notice of stretches without frames."""
    steps = np.diff(times)
    if len(steps) == 0:
        return
    gaps = steps > max(NOTICED_GAP, 5.0 * float(np.median(steps)))
    if gaps.any():
        longest = int(np.argmax(steps))
        where = f"the longest {steps[longest]:.2f} s, after {times[longest]:.6f} s"
        notices.append(f"frames are missing {_times(int(gaps.sum()))} for more than {NOTICED_GAP:g} s; {where}")


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
