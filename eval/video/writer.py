"""Videos of runs as MP4: the writer, a page whose moving parts are drawn over what stands still, pictures on it."""

import contextlib
import importlib
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vssm_gym.errors import InputError
from vssm_gym.progress import OnProgress

RATE = 15  # frames a second
SIZE, DPI = (12.8, 7.2), 100  # inches and dots an inch: 1280 x 720
HOLD = 2.0  # s that the last frame stays
HOW = "imageio-ffmpeg, which writes videos: pip install 'vssm-gym[viz]'"


def check_writer(command: str) -> None:
    """Raise :class:`InputError` where videos cannot be written; to be asked before a run, not after it."""
    try:
        importlib.import_module("imageio_ffmpeg")  # of an extra; what imageio writes MP4 with
    except ImportError as reason:
        raise InputError(command, "video", f"{HOW} ({reason})") from reason


def write_frames(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    total: int,
    on_progress: OnProgress | None = None,
) -> None:
    """Write frames as MP4 (H.264).

    Args:
        path: of the file, which ends in ``.mp4``.
        frames: one at least; the last one stays for a while.
        total: how many.
        on_progress: called with ("video", done, total).
    """
    writer: Any = imageio.get_writer(
        path, format="FFMPEG", fps=RATE, codec="libx264", quality=6, ffmpeg_log_level="error"
    )
    # As a context of its own the writer leaves ffmpeg running where a frame fails
    with contextlib.closing(writer), warnings.catch_warnings():
        # JAX warns of every fork; this one, at the first frame, becomes ffmpeg at once
        warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
        for i, frame in enumerate(frames):
            writer.append_data(frame)
            if on_progress:
                on_progress("video", i + 1, total)
        for _ in range(round(HOLD * RATE)):
            writer.append_data(frame)


class Window:
    """A picture's place in a frame. It is enlarged by hand: matplotlib takes longer for that than for all else."""

    def __init__(self, axes: Axes, shape: tuple[int, ...], frame: tuple[int, int], upwards: bool) -> None:
        """``shape`` is that of the pictures, ``frame`` (height, width); with ``upwards`` row 0 is the lowest."""
        axes.apply_aspect()
        (left, bottom), (right, top) = np.rint(axes.get_window_extent().get_points()).astype(int)
        self._place = slice(frame[0] - top, frame[0] - bottom), slice(left, right)
        rows = np.arange(top - bottom) * shape[0] // (top - bottom)
        self._rows = (rows[::-1] if upwards else rows)[:, None]
        self._columns = np.arange(right - left) * shape[1] // (right - left)

    def show(self, image: UInt8[np.ndarray, "rows columns 3"], frame: UInt8[np.ndarray, "height width 4"]) -> None:
        """Draw the picture into the frame, its pixels repeated."""
        frame[(*self._place, slice(3))] = image[self._rows, self._columns]


class Page:
    """A figure of which a frame draws only what moves: pictures first, then artists in the order of :meth:`moves`."""

    def __init__(self) -> None:
        self.figure = Figure(figsize=SIZE, dpi=DPI)
        self.size = round(DPI * SIZE[1]), round(DPI * SIZE[0])  # (height, width), pixels
        self._canvas = FigureCanvasAgg(self.figure)
        self._moving: list[Artist] = []
        self._background: Any = None

    def moves(self, artist: Any) -> Any:
        """Draw ``artist`` in every frame; the artist."""
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def frame(
        self, pictures: Iterable[tuple[Window, UInt8[np.ndarray, "rows columns 3"]]]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The frame of the moving artists as they are now; what stands still is drawn with the first one."""
        if self._background is None:
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._background)
        frame = np.asarray(self._canvas.buffer_rgba())
        for window, picture in pictures:
            window.show(picture, frame)
        for artist in self._moving:
            (artist.axes or self.figure).draw_artist(artist)
        return frame[..., :3].copy()
