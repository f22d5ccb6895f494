"""A video of one run of an explorer: what it sees, what it believes, where it wants to go and why, how far it has come.

All that does not move is drawn once; a frame draws the rest over it.
"""

import importlib
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.errors import InputError
from vssm_gym.eval import explore_pictures as pictures
from vssm_gym.eval.explore_recording import EVERY, Recording
from vssm_gym.eval.maps import Progress

RATE = 15  # frames a second
SIZE, DPI = (12.8, 7.2), 100  # inches and dots an inch: 1280 x 720
HOLD = 2.0  # s that the last frame stays
HOW = "imageio-ffmpeg, which writes videos: pip install 'vssm-gym[viz]'"
_CHARACTERS = 92  # of a status that fit into a line


def check_writer(command: str) -> None:
    """Raise :class:`InputError` where videos cannot be written; to be asked before a run, not after it."""
    try:
        importlib.import_module("imageio_ffmpeg")  # of an extra; what imageio writes MP4 with
    except ImportError as reason:
        raise InputError(command, "video", f"{HOW} ({reason})") from reason


def write_video(path: Path, recording: Recording, title: str, progress: Progress | None = None) -> None:
    """Write the run as MP4 (H.264), several times as fast as it was driven.

    Args:
        path: of the file, which ends in ``.mp4``.
        recording: of a run that has ended, with a moment at least.
        title: who explores what.
        progress: told ("video", done, total).
    """
    sheet, n = Sheet(recording, title), len(recording.moments)
    writer: Any = imageio.get_writer(
        path, format="FFMPEG", fps=RATE, codec="libx264", quality=6, ffmpeg_log_level="error"
    )
    with writer:
        for i in range(n):
            frame = sheet.draw(i)
            writer.append_data(frame)
            if progress:
                progress("video", i + 1, n)
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


class Sheet:
    """The page whose moving parts are set by :meth:`draw`."""

    def __init__(self, recording: Recording, title: str) -> None:
        self._recording, self._bounds = recording, recording.bounds()
        self._metres = np.array([moment.metres for moment in recording.moments])
        self._coverage = 100.0 * np.array([moment.coverage for moment in recording.moments])
        figure = Figure(figsize=SIZE, dpi=DPI)
        self._canvas = FigureCanvasAgg(figure)
        self._size = round(DPI * SIZE[1]), round(DPI * SIZE[0])
        figure.text(0.02, 0.95, title, fontsize=15, weight="bold")
        speed = EVERY * HolonomicRobot().dt * RATE
        figure.text(0.98, 0.95, f"{speed:g} x as fast as driven", fontsize=10, ha="right", color="0.35")
        self._moving: list[Artist] = []
        self._see(figure)
        self._curve(figure)
        self._plan(figure)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def draw(self, i: int) -> UInt8[np.ndarray, "height width 3"]:
        """The frame of moment ``i``."""
        moment = self._recording.moments[i]
        self._driven.set_data(*self._recording.driven(moment).T)
        self._way.set_data(*(np.empty((2, 0)) if moment.way is None else moment.way.T))
        self._robot.set_xy(pictures.robot_outline(moment.planar))
        if self._dots is not None:
            tour = moment.tour
            order = np.empty(0, int) if tour is None else np.argsort(tour.nats)
            self._dots.set_offsets(np.empty((0, 2)) if tour is None else tour.xy[order])
            self._dots.set_array(np.empty(0) if tour is None else 1e-3 * tour.nats[order])
            self._ring.set_data(*(np.empty((2, 0)) if tour is None else tour.xy[[tour.first]].T))
        self._covered.set_data(self._metres[: i + 1], self._coverage[: i + 1])
        self._now.set_data(self._metres[i : i + 1], self._coverage[i : i + 1])
        self._numbers.set_text(
            f"{self._coverage[i]:.0f} % covered      {moment.metres:.1f} m      {moment.seconds:.0f} s"
        )
        self._status.set_text(moment.status[:_CHARACTERS])
        self._canvas.restore_region(self._background)
        frame = np.asarray(self._canvas.buffer_rgba())
        self._image.show(moment.rgb, frame)
        self._cells.show(pictures.plan_image(moment.plan, self._bounds), frame)
        for artist in self._moving:
            (artist.axes or self._canvas.figure).draw_artist(artist)
        return frame[..., :3].copy()

    def _moves(self, artist: Any) -> Any:
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def _see(self, figure: Figure) -> None:
        """What the robot sees, and the numbers."""
        rgb = self._recording.moments[0].rgb
        axes = figure.add_axes((0.02, 0.475, 0.3, 0.445), xlim=(0, rgb.shape[1]), ylim=(0, rgb.shape[0]))
        pictures.bare(axes)
        self._image = Window(axes, rgb.shape, self._size, upwards=False)
        self._numbers = self._moves(figure.text(0.02, 0.425, "", fontsize=13))

    def _curve(self, figure: Figure) -> None:
        """Coverage by metres driven."""
        axes = figure.add_axes((0.06, 0.1, 0.26, 0.28))
        longest = max(float(self._metres[-1]), 1.0)
        axes.set(xlim=(0.0, 1.02 * longest), ylim=(0.0, 102.0), xlabel="driven, m", ylabel="covered, %")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.plot(self._metres, self._coverage, color="0.85", linewidth=1.4)
        self._covered = self._moves(axes.plot([], [], color=pictures.DRIVEN_COLOUR, linewidth=2)[0])
        self._now = self._moves(axes.plot([], [], "o", color=pictures.DRIVEN_COLOUR)[0])

    def _plan(self, figure: Figure) -> None:
        """What the robot believes of the floor, and where it wants to go."""
        norm, bounds = pictures.gain_norm(self._recording), self._bounds
        axes = figure.add_axes((0.345, 0.1, 0.57, 0.82), xlim=bounds[:, 0], ylim=bounds[:, 1])
        pictures.bare(axes)
        shape = pictures.plan_image(self._recording.moments[0].plan, bounds).shape
        self._cells = Window(axes, shape, self._size, upwards=True)
        self._driven, self._way = (
            self._moves(axes.plot([], [], color=colour, linewidth=width, path_effects=pictures.HALO)[0])
            for colour, width in ((pictures.DRIVEN_COLOUR, 1.6), (pictures.WAY_COLOUR, 2.0))
        )
        self._dots: Any = None
        if norm is not None:
            dots = axes.scatter([], [], c=[], cmap=pictures.GAIN_COLOURS, norm=norm, **pictures.CANDIDATE)
            self._dots = self._moves(dots)
            self._ring = self._moves(axes.plot([], [], color=pictures.WAY_COLOUR, **pictures.CHOSEN)[0])
            pictures.label_gain(figure.colorbar(dots, cax=figure.add_axes((0.93, 0.2, 0.013, 0.62))))
        self._robot = self._moves(pictures.draw_robot(axes, self._recording.moments[0].planar))
        for artist in pictures.draw_scale(axes, bounds):
            self._moves(artist)
        self._status = self._moves(figure.text(0.63, 0.065, "", fontsize=11, ha="center"))
        handles = pictures.plan_handles(with_gain=norm is not None)
        figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.63, 0.005), **pictures.KEY)
