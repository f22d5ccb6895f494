"""Write videos as MP4 from pages whose moving parts are drawn over static ones."""

import contextlib
import importlib
import itertools
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from jaxtyping import UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vssm_gym.errors import InputError
from vssm_gym.eval.video.pictures import bare
from vssm_gym.files.atomic import atomic_write
from vssm_gym.progress import OnProgress
from vssm_gym.viz.pictures import take_literally

VIDEO_RATE = 15  # frames a second
VIDEO_CRF = 20  # H.264's constant rate factor: 0 is lossless, 51 the worst
VIDEO_SIZE, VIDEO_DPI = (12.8, 7.2), 100  # inches and dots an inch: 1280 x 720
HOLD = 2.0  # s that the last frame is shown
Place: TypeAlias = tuple[float, float, float, float]  # left, bottom, width, height of axes, as parts of the page
CAMERA_PLACE: Place = (0.02, 0.475, 0.3, 0.445)  # of the robot's image
STATUS_CHARACTERS = 92  # of an agent's status: a line holds no more
HOW = "imageio-ffmpeg, which writes videos: pip install -c constraints.txt '.[viz]'"


def check_writer(command: str) -> None:
    """Raise :class:`InputError` where videos cannot be written; call it before a run."""
    try:
        importlib.import_module("imageio_ffmpeg")  # of an extra; what imageio writes MP4 with
    except ImportError as reason:
        raise InputError(command, "video", f"{HOW} ({reason})") from reason


def write_video(
    path: Path,
    draw: Callable[[int], UInt8[np.ndarray, "height width 3"]],
    n: int,
    on_progress: OnProgress | None = None,
) -> None:
    """Write ``n`` >= 1 frames, ``draw(0)`` to ``draw(n - 1)``, as MP4; the file appears whole or not at all.

    Args:
        path: of the file, which ends in ``.mp4``.
        draw: returns the frame of a number.
        n: number of frames.
        on_progress: called with ("video", done, total).

    Raises:
        OSError: ffmpeg did not write the whole video.
    """
    with atomic_write(path) as temporary:
        write_frames(temporary, (draw(i) for i in range(n)), n, on_progress)


def write_frames(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    total: int,
    on_progress: OnProgress | None = None,
) -> None:
    """Write frames as MP4 (H.264).

    Args:
        path: of the file, of any name.
        frames: at least one, of even height and width; the last one is held.
        total: number of frames.
        on_progress: called with ("video", done, total).

    Raises:
        OSError: ffmpeg did not write the whole video.
    """
    rest = iter(frames)
    first = next(rest)
    with _ffmpeg(path, first.shape) as video:
        for i, frame in enumerate(itertools.chain([first], rest)):
            video.write(np.ascontiguousarray(frame).data)
            if on_progress:
                on_progress("video", i + 1, total)
        for _ in range(round(HOLD * VIDEO_RATE)):
            video.write(np.ascontiguousarray(frame).data)


@contextlib.contextmanager
def _ffmpeg(path: Path, shape: tuple[int, ...]) -> Iterator[IO[bytes]]:
    """Yield the input of ffmpeg, which takes frames of ``shape``; check at the end that all was written."""
    program = importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    taken = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{shape[1]}x{shape[0]}", "-r", str(VIDEO_RATE), "-i", "-")
    given = ("-an", "-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", str(VIDEO_CRF), "-f", "mp4", str(path))
    process = subprocess.Popen(
        [program, "-y", "-v", "error", *taken, *given],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        process_group=0,  # Ctrl-C is for this process alone
    )
    assert process.stdin is not None
    try:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and says why
            yield process.stdin
        said = process.communicate()[1].decode(errors="replace").strip()
    except BaseException:
        process.kill()
        process.communicate()
        raise
    if process.returncode:
        raise OSError(f"{path}: ffmpeg ended with {process.returncode}: {said}")


class Window:
    """Hold a picture's place in a frame; enlarging by indices is much faster than matplotlib's resampling."""

    def __init__(self, axes: Axes, shape: tuple[int, ...], frame: tuple[int, int], upwards: bool) -> None:
        """Place pictures of ``shape`` in a ``frame`` (height, width); with ``upwards`` row 0 is the lowest."""
        axes.apply_aspect()
        (left, bottom), (right, top) = np.rint(axes.get_window_extent().get_points()).astype(int)
        self._place = slice(frame[0] - top, frame[0] - bottom), slice(left, right)
        rows = np.arange(top - bottom) * shape[0] // (top - bottom)
        self._rows = (rows[::-1] if upwards else rows)[:, None]
        self._columns = np.arange(right - left) * shape[1] // (right - left)

    def show(self, image: UInt8[np.ndarray, "rows columns 3"], frame: UInt8[np.ndarray, "height width 4"]) -> None:
        """Draw the picture into the frame, repeating its pixels."""
        frame[(*self._place, slice(3))] = image[self._rows, self._columns]


class Page:
    """Hold a figure of which a frame redraws the moving parts only: pictures, then artists in the order of addition."""

    def __init__(self) -> None:
        self.figure = Figure(figsize=VIDEO_SIZE, dpi=VIDEO_DPI)
        self.size = round(VIDEO_DPI * VIDEO_SIZE[1]), round(VIDEO_DPI * VIDEO_SIZE[0])  # (height, width), pixels
        self._canvas = FigureCanvasAgg(self.figure)
        self._moving: list[Artist] = []
        self._background: Any = None

    def moves(self, artist: Any) -> Any:
        """Draw ``artist`` in every frame; return it."""
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def head(self, title: str, step: float) -> None:
        """Write the title, and how fast frames of ``step`` s each are shown."""
        self.figure.text(0.02, 0.95, title, fontsize=15, weight="bold")
        faster = f"{step * VIDEO_RATE:g} x as fast as driven"
        self.figure.text(0.98, 0.95, faster, fontsize=10, ha="right", color="0.35")

    def camera(self, place: Place, shape: tuple[int, ...]) -> Window:
        """Add axes for images of ``shape`` (height, width, ...), row 0 on top; return their place in frames."""
        axes = self.figure.add_axes(place, xlim=(0, shape[1]), ylim=(0, shape[0]))
        bare(axes)
        return self.window(axes, shape, upwards=False)

    def window(self, axes: Axes, shape: tuple[int, ...], upwards: bool) -> Window:
        """Return the place of ``axes`` in frames, for pictures of ``shape``; with ``upwards`` row 0 is the lowest."""
        return Window(axes, shape, self.size, upwards)

    def frame(
        self, pictures: Iterable[tuple[Window, UInt8[np.ndarray, "rows columns 3"]]]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draw a frame with the moving artists' present state; the first frame draws the static parts."""
        if self._background is None:
            take_literally(self.figure)
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._background)
        frame = np.asarray(self._canvas.buffer_rgba())
        for window, picture in pictures:
            window.show(picture, frame)
        for artist in self._moving:
            (artist.axes or self.figure).draw_artist(artist)
        return frame[..., :3].copy()
